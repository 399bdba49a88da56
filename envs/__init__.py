"""The environments: differentiable simulations whose parameters span a landscape."""
