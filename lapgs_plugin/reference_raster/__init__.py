"""CPU rasterizers: an oracle to read and a fast one to train with."""
