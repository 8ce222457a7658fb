"""What nodes share: parameters, QoS, workers, frames, timing."""
