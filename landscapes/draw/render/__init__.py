"""Lit pictures of surfaces and episodes (pyvista, off-screen)."""
