"""Measures of a landscape: ruggedness, noise, discontinuities, gradients, sensitivity, fidelity."""
