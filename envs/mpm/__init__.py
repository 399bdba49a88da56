"""The MLS-MPM scenes: syrup and plasticine."""
