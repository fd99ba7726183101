"""Networks: each a thin composition of shared parts."""
