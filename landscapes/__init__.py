"""Landscapes: their parameter spaces, planes, samples, measures and pictures."""
