"""Train a large scene as tiles of nested levels over a base that all share, and merge them into one run."""
