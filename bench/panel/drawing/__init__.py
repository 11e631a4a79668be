"""What a person is shown in place of words: the mounting of the block, the turn of the head."""
