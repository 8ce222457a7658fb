"""What tests mean by two motions that are near each other."""

__all__ = ["are_near"]


def are_near(T_a, T_b, max_m, max_rad):
    """Whether both the distance and the turn between two motions are below these."""
    distance_m, turn_rad = T_a.distance_to(T_b)
    return distance_m < max_m and turn_rad < max_rad
