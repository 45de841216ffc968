"""The worlds that policies act in.

``colored_keys`` (MiniGrid), and ``tabular``, which turns them into tables; ``door`` (MuJoCo),
``many_doors`` side by side, and about them ``hooking``, a controller by hand, and ``pulling``, the
rule that tells how a door was pulled.
"""
