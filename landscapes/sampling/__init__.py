"""How a slice is filled: in which order, within which memory, by which workers."""
