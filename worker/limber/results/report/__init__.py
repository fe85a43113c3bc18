"""The report: one self-contained page with the figures and tables of all that was done."""
