"""Measure lapgs_plugin: experiments of many runs, and benchmarks of its kernels. The command is `lapgs bench`."""
