"""Keys of `Step.info`: numbers of a step in addition to frames, states and actions."""

from __future__ import annotations

# Before the name of an arm
ALIGNMENT = "alignment_"  # time from its state to the nearest package [s]
LIMITS_HIT = "limits_hit_"  # targets that were shortened or refused so far
PACKAGES_LOST = "packages_lost_"  # packages of its controller that are missing in this step
# Before the name of a sensor
PICTURES_LOST = "pictures_lost_"  # frames of its camera that never arrived, so far
PICTURES_DAMAGED = "pictures_damaged_"  # frames that could not be read, so far
PICTURES_REPEATED = "pictures_repeated_"  # frames with the same picture as the frame before, so far
CONTACT_SIGNAL = "contact_signal_"
STALE_REFERENCE = "stale_"  # 1: the reference is not valid any more
COLOUR_DRIFT = "drift_"  # change of the untouched gel's colour since the reference [-]
BACKGROUND_SLOPE = "background_"  # mean slope that corresponds to a drift of the light [degrees]
COLOURS_OUT_OF_RANGE = "beyond_"  # share of the picture whose colours are outside the calibrated slopes
VISIBLE_MARKERS = "kept_"  # share of the markers that were found
MAX_DEPTH = "deepest_"  # of the height of its gel [m]
MAX_SLOPE = "steepest_"  # of its gel [-]
MAX_FLOW = "flow_"  # longest displacement of a marker [m]
# By themselves
SETTLED = "settled"
TRAINING_DISTANCE = "training_distance"  # distance of the observation from the training range, over the limit
TRAINING_KNOWN = "training_range_known"  # 0: a learned policy without its training range
TACTILE_DISTANCE = "felt_distance"  # from the goal, estimated from tactile observations only [m]

ARM_KEYS = (ALIGNMENT, LIMITS_HIT, PACKAGES_LOST)
SENSOR_KEYS = (
    CONTACT_SIGNAL,
    MAX_DEPTH,
    MAX_SLOPE,
    MAX_FLOW,
    STALE_REFERENCE,
    COLOUR_DRIFT,
    BACKGROUND_SLOPE,
    COLOURS_OUT_OF_RANGE,
    VISIBLE_MARKERS,
    PICTURES_LOST,
    PICTURES_DAMAGED,
    PICTURES_REPEATED,
)
