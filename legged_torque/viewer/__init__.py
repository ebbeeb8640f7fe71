"""Watching and steering a trained robot live, and videos. The web page needs the extra ``viewer``."""
