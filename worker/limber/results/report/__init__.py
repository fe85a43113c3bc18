"""The report: one self-contained page with the figures and tables of all results."""
