"""Medium-aware training: a folder of data sets and a base checkpoint in, an adapter out (`train.train_sfm`)."""
