"""The documentation; what is Python here makes pages of what there is to document."""
