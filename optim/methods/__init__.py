"""The optimisers, one file a family."""
