"""Single balls on Warp: against the ground by penalty, among walls and bars by impacts."""
