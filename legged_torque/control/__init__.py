"""Contact-consistent whole-body control: eqs. 2 to 6 and 9 to 11 of the paper, batched on the device."""
