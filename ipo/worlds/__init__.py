"""The worlds that policies act in: coloured keys (MiniGrid) and doors (MuJoCo)."""
