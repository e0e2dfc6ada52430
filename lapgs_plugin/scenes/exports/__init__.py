"""Read exports of other programs as scenes: one file for each program, which another package can add to."""
