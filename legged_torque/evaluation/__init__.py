"""Measuring policies and speed."""
