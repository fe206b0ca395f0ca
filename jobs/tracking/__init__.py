"""What MLflow is told: runs, pages, child runs and registered models. Only this package imports it."""
