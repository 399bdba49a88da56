"""Checks that every objective has to pass, one file for each family of them."""
