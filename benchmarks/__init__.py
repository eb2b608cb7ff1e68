"""How fast it is, side by side with what an SB3 user could pick instead: ``python -m benchmarks`` (``make benchmark``)."""
