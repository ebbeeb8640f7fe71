"""What maintainers run in a checkout; not a part of the package."""
