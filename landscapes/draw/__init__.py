"""Pictures of landscapes, one folder for each medium; each function takes records and returns the medium's object."""
