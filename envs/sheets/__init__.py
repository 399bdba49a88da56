"""The mass-spring scenes: cloth and pancake."""
