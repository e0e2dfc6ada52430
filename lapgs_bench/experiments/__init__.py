"""Run experiments: many runs described by one file, spread over processes, kept in one store, shown as tables.

    schema.py       the content of an experiment file; settings.py: what the command line adds
    standard.py     standard data sets, backbones' published options, the paper's figures (all in data/)
    expansion.py    a file -> runs: scenes x backbones x variants x seeds, variants taking turns
    mistakes.py     collects all mistakes of an experiment; cli/bench_check.py finds them by rehearsing every run
    commands.py     a run -> the commands that train and evaluate it
    store.py        claims and results of runs: SQLite, safe against dying and competing workers
    execution.py    prepares the runs, and follows them until they have ended
    worker.py       takes runs from the store until none is left; leash.py ends a run whose worker died
    launchers.py    workers on this machine, on Slurm, on Ray
    rows.py         a run's folder -> one flat row
    aggregate.py    rows -> a table of means, spreads, ratios and the paper's figures; tables.py writes it
    exports.py      rows as files; report.py: a page made from them

The command is `lapgs bench EXPERIMENT`; `lapgs help measuring` says how to write one.
"""
