"""Programs for maintainers, run from a checkout: ``python tools/accuracy.py``. They are not in the package."""
