"""The base task of all robots."""
