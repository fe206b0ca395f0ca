"""From numbers to what a person reads: statistics, tables, plots and videos."""
