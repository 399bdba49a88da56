"""What a landscape is: its parameter space, its plane, its samples and its pictures."""
