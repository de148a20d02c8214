"""What is counted between a palm's datagrams and its readings."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.udp.link import DatagramCounters


@dataclass(slots=True)
class PalmCounters(DatagramCounters):
    """What became of packets, values and angles.

    `readings` and `faulty_readings` are the tactile ones.
    """

    packets: int = 0
    """Packets with sensor data."""
    bad_lengths: int = 0
    """Datagrams of a length that no known palm sends."""
    empty_packets: int = 0
    """Packets that the palm was too late to fill."""
    service_packets: int = 0
    """Packets of a service mode of the palm, in which `sensors` holds other things."""
    nonsense_packets: int = 0
    """Packets with a field that no palm sends."""
    lost_packets: int = 0
    """Packets that a round was handed over without, for whatever reason."""
    duplicate_packets: int = 0
    """Packets that came again; the copy is dropped."""
    reordered_packets: int = 0
    """Packets that came after their successor and in time for their round."""
    late_packets: int = 0
    """Packets that came when their round was over; dropped."""
    conflicting_packets: int = 0
    """Packets for a place where another one already was; both are dropped."""
    unsynchronised_packets: int = 0
    """Packets dropped until a round began, after opening or an outage."""
    interrupted_rounds: int = 0
    """Rounds dropped because the link broke in the middle."""
    metadata_packets: int = 0
    """Packets whose tactile part is about the sensors themselves."""
    unknown_types: int = 0
    """Packets whose `tactile_type` nobody knows."""
    held_values: int = 0
    """Electrode values that the palm marked as not fresh."""
    not_counts: int = 0
    """Electrode values outside 0..4095."""
    invalid_fingers: int = 0
    """Slots of wanted fingers that the palm marked as not valid."""
    absent_fingers: int = 0
    """Fingers of rounds without a sensor: channels that are no counts, or nothing but zeros."""
    joint_readings: int = 0
    """Joint readings handed over."""
    bad_angles: int = 0
    """Angles handed over as NaN although the joint is calibrated: its raw value is no count."""
    impossible_angles: int = 0
    """Angles handed over that are out of the joint's range by more than 10 degrees."""
    other_palms: int = 0
    """Packets of another kind of palm than the first since the link came up; dropped."""
