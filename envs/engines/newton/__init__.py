"""Newton's solvers as they are."""
