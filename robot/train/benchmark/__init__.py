"""The benchmark of policies, version v1: frozen episodes, scores with hashes, verification, comparison.

It ranks policies. `tacsim bench` (the folder benchmarks/) measures speed and error of the simulator instead.
"""
