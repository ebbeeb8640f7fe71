"""A trained policy outside its training: export, and running it without torch, Warp or the tasks of this package."""
