"""MLS-MPM on Warp: particles that meet on a grid."""
