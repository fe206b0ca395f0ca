"""Pages of results: the report, the claims of the paper, learning curves, and published policies."""
