"""Watching and steering a trained robot live; needs the extra ``viewer`` for the page, nothing else needs this."""
