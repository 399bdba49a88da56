"""Pictures of landscapes: one file per medium; each takes records and returns the medium's own object."""
