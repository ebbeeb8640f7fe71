"""Reports of experiments and runs: tables, figures and one HTML page."""
