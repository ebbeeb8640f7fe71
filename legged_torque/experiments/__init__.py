"""Matrices of trainings and evaluations, and their tables, figures and reports."""
