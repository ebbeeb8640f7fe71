"""Live views of trained robots, and videos. The page needs the extra ``viewer``, videos need ``video``."""
