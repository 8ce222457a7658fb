"""ROS 2 nodes: wire, convert, call the core, publish; no arithmetic."""
