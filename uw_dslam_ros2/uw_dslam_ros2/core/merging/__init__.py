"""Many submaps to one map: queue, pose graph, consistency, fusion."""
