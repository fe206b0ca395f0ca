"""Studies: which policies are trained and compared under which conditions, declared in one file each."""
