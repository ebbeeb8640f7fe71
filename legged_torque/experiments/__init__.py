"""Matrices of trainings and evaluations, and what comes of them: tables, figures, reports."""
