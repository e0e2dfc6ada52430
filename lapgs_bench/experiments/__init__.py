"""Run experiments: many runs described by one file, spread over processes, kept in one store, shown as tables."""
