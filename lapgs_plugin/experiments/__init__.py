"""Experiments: many runs described by one file, spread over processes, kept in one store, shown as tables.

    schema.py       what an experiment file may say
    standard.py     the standard data sets, backbones' published options, the paper's printed figures (all in data/)
    expansion.py    a file -> runs: scenes x backbones x variants x seeds, variants taking turns
    mistakes.py     what is wrong with an experiment, told at once; cli/bench_check.py finds it by rehearsing every run
    commands.py     a run -> the commands that train and measure it
    store.py        who runs what, and what came out: SQLite, safe against dying and competing workers
    worker.py       takes runs from the store until none is left; leash.py ends a run whose worker died
    launchers.py    workers on this machine, on Slurm, on Ray
    rows.py         a run's folder -> one flat row
    aggregate.py    rows -> a table of means, spreads, ratios and the paper's figures; tables.py writes it

The command is `lapgs bench EXPERIMENT.toml`; docs/measuring.md says how to write one.
"""
