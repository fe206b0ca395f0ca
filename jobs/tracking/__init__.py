"""Records in MLflow: runs, pages, child runs and registered models. Only this package imports it."""
