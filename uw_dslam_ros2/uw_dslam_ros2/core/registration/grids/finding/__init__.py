"""Where one map may lie in another: candidates, and the search that proves."""
