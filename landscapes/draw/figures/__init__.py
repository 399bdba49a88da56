"""Figures of matplotlib, one file for each kind."""
