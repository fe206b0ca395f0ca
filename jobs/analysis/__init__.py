"""Presentation of results: statistics, tables, plots and videos."""
