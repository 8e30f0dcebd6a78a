"""What moves: found (`movement`), followed (`tracking`, `passages`), placed (`courses`), born (`births`, `travel`)."""
