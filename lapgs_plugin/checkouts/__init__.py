"""Load a checkout's script, replace its symbols, and give it views of another size or a CPU as its GPU."""
