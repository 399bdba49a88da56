"""Mass-spring sheets on Warp."""
