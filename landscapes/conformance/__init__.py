"""What every objective owes, one file for each family of checks."""
