"""Draw quality over seconds: `lapgs bench pareto`."""
