"""Definitions of drivers' messages, for bags that have none (sqlite3 of Humble and before).

Only where all versions of a package agree; field for field as upstream.
"""

from __future__ import annotations

__all__ = ["DEFINITIONS"]

DEFINITIONS: dict[str, str] = {
    "ping360_sonar_msgs/msg/SonarEcho": """
        std_msgs/Header header
        float32 angle
        uint8 gain
        uint16 number_of_samples
        uint16 transmit_frequency
        uint16 speed_of_sound
        uint8 range
        uint8[] intensities
    """,
    "oculus_interfaces/msg/Ping": """
        std_msgs/Header header
        uint32 ping_id
        uint32 ping_firing_date
        float64 range
        float64 gain_percent
        float64 frequency
        float64 speed_of_sound_used
        float64 range_resolution
        float64 temperature
        float64 pressure
        uint8 master_mode
        bool has_gains
        uint16 n_ranges
        uint16 n_beams
        uint32 step
        uint8 sample_size
        int16[] bearings
        uint8[] ping_data
    """,
    "marine_acoustic_msgs/msg/RawSonarImage": """
        std_msgs/Header header
        PingInfo ping_info
        float32 sample_rate
        uint32 samples_per_beam
        uint32 sample0
        float32[] tx_delays
        float32[] tx_angles
        float32[] rx_angles
        SonarImageData image
    """,
}
"""Text by type."""
