"""The fifteen promises of arms and cameras: their figures, from the rows of one run, and the tests of their logic."""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks.pages.targets import Target, pick


@dataclass(frozen=True, slots=True)
class Promise:
    """One promise. Its logic is in `tests` (file::function, below tests/), its figures in `figures`."""

    name: str
    text: str
    tests: tuple[str, ...]
    figures: tuple[Target, ...] = ()


def _at_most(case: str, variant: str, must: float, unit: str, name: str) -> Target:
    return Target(name, unit, must, None, pick("error", case, variant))


def _never(case: str, variant: str, name: str) -> Target:
    return _at_most(case, variant, 0, "", name)


UR, SERVO, CAMERA, CAPTURE = (f"robot/test_{name}.py::test_" for name in ("ur", "servo", "camera", "capture"))
LIMITS, CONTRACT = "tacsim/test_limits.py::test_", "contract/test_contract.py::test_"

PROMISES: tuple[Promise, ...] = (
    Promise(
        "Box",
        "No target leaves the workspace, whatever is asked; an arm without limits does not connect.",
        (
            LIMITS + "a_million_hostile_targets_none_passes_that_is_no_pose",
            LIMITS + "a_million_hostile_ways_end_inside",
            UR + "five_thousand_hostile_targets_leave_no_trace_beyond_the_limits",
            UR + "the_measured_arm_stays_in_the_box_too",
            UR + "limits_have_no_default_workspace",
            UR + "an_arm_outside_its_workspace_does_not_connect",
        ),
        (
            _never("box_guard", "outside", "of 1,000,000 hostile actions through the guard, outside"),
            _never("box_wire", "outside", "of 5,000 hostile actions over the wire, received targets outside"),
            _at_most("box_measured", "beyond", 1, "mm", "measured tool beyond the box"),
        ),
    ),
    Promise(
        "Speed",
        "Speed, acceleration and joint steps of what is sent stay within their limits; what is no pose makes it hold.",
        (
            UR + "five_thousand_hostile_targets_leave_no_trace_beyond_the_limits",
            UR + "what_is_no_pose_is_refused",
            SERVO + "what_is_no_pose_makes_it_hold",
            SERVO + "joint_steps_and_singularities_slow_it_down",
            "robot/test_trajectory.py::test_targets_that_change_on_the_way_never_lead_outside",
        ),
        (
            _at_most("box_wire", "speed", 101, "%", "fastest received target, of the limit"),
            _at_most("box_wire", "acceleration", 101, "%", "largest acceleration received, of the limit"),
            _at_most("box_wire", "joint step", 100.1, "%", "largest joint step received, of the limit"),
        ),
    ),
    Promise(
        "Force",
        "Too much force stops the arm in the period of its package.",
        (
            UR + "force_limit_stops_in_the_period_of_its_package",
            SERVO + "too_much_force_stops_from_the_measured_pose",
            SERVO + "a_force_that_is_no_number_is_too_much",
        ),
        (
            _never("force", "approach commands", "approach commands later than 2 ms after the package"),
            _at_most("force", "standstill", 150, "ms", "standstill, from 50 mm/s"),
            _at_most("force", "status published", 4, "ms", "status published"),
            _at_most("force", "overshoot", 2, "N", "force beyond the limit, wall of 2 N/mm at 50 mm/s"),
        ),
    ),
    Promise(
        "Stale",
        "A silent link is told and outlived; a frame beyond its age is refused.",
        (
            UR + "a_silent_link_is_lost_and_the_program_that_asks_is_not",
            UR + "a_cut_link_is_lost_for_good_until_recover",
            UR + "a_stopped_controller_is_a_lost_link",
            UR + "numbers_that_are_none_are_no_package",
            CAMERA + "frames_beyond_the_age_limit_are_refused",
        ),
        (
            _at_most("silent_link", "reported", 60, "ms", "silent link reported"),
            _never("silent_link", "lost answers", "processes that did not outlive it"),
        ),
    ),
    Promise(
        "Late policy",
        "Without a fresh action the arm holds, says so, and goes on from where it is measured.",
        (
            UR + "without_actions_the_arm_holds_and_goes_on_from_there",
            SERVO + "an_old_command_is_not_followed_and_a_late_one_brakes",
            SERVO + "after_a_hold_it_goes_on_from_where_the_arm_is",
        ),
        (
            _at_most("late_policy", "hold", 210, "ms", "hold told after the last action (time-out 200 ms)"),
            _at_most("late_policy", "first step", 101, "%", "first step when it goes on, of one period's limit"),
        ),
    ),
    Promise(
        "Death",
        "A policy or a worker that is killed leaves a standing arm; another worker is there soon.",
        (
            UR + "a_policy_that_dies_leaves_a_standing_arm_and_nothing_else",
            UR + "a_killed_worker_is_told_and_replaced",
            UR + "a_stopped_worker_is_a_lost_link_and_can_be_replaced",
        ),
        (
            _at_most("policy_death", "still", 200, "ms", "policy killed at 0.1 m/s: standstill"),
            _at_most("policy_death", "way", 5, "mm", "policy killed at 0.1 m/s: way"),
            _at_most("worker_death", "still", 250, "ms", "worker killed at 0.1 m/s: the watchdog's stop"),
            _at_most("worker_death", "new worker", 0.5, "s", "new worker, ready"),
        ),
    ),
    Promise(
        "Stops",
        "A stop is told by its kind; nothing moves before recover(), and no old command comes again.",
        (
            UR + "a_protective_stop_is_told_and_only_recover_ends_it",
            UR + "an_emergency_stop_waits_for_a_person",
            UR + "a_program_stopped_from_outside_is_told",
            UR + "connecting_to_a_stopped_arm_says_so",
        ),
        (
            _at_most("protective_stop", "status", 20, "ms", "protective stop told"),
            _at_most("protective_stop", "motion", 1e-3, "mm", "motion before and by recover() (it settles to less)"),
            _never("protective_stop", "replayed", "old commands that came again"),
        ),
    ),
    Promise(
        "One commander",
        "A second driver is refused, the first goes on.",
        (
            UR + "a_second_driver_is_refused_and_the_first_goes_on",
            UR + "a_field_bus_that_holds_the_registers_is_busy_too",
        ),
        (
            _at_most("second_commander", "told", 1, "s", "DeviceBusyError"),
            _never("second_commander", "disturbed", "first drivers that were disturbed"),
        ),
    ),
    Promise(
        "Connecting",
        "Connecting to nobody ends with its time-out and holds up no other thread.",
        (
            UR + "connecting_to_nobody_ends_in_time_and_blocks_no_thread",
            UR + "a_stopped_controller_is_a_lost_link",
            CAPTURE + "a_black_hole",
        ),
        tuple(
            _at_most("connecting", f"{peer}: blocked", 50, "ms", f"interpreter blocked, {peer} peer")
            for peer in ("silent", "refusing", "black hole")
        ),
    ),
    Promise(
        "One instant",
        "All fields of a state are of one package; a pose is that of the picture's exposure.",
        (
            UR + "all_fields_of_a_state_are_of_one_instant",
            UR + "a_hundred_thousand_looks_and_none_is_torn",
            "robot/test_snapshot.py::test_no_torn_read_in_a_hundred_thousand",
            "robot/test_align.py::test_injected_latencies_leave_less_than_a_millisecond_of_motion",
        ),
        (_never("one_instant", "torn", "torn snapshots in 100,000 reads"),),
    ),
    Promise(
        "Camera",
        "The newest frame, never an old one as new; back by itself; a source that is not the one described is refused.",
        (
            CAMERA + "a_consumer_that_pauses_gets_the_newest_frame",
            CAMERA + "a_stall_is_a_timeout_then_a_new_opening",
            CAMERA + "a_camera_that_is_killed_and_started_again",
            CAMERA + "between_two_exposures_the_same_frame_comes_again_with_the_same_index",
            CAPTURE + "a_frame_that_is_sent_again_is_no_new_one",
            CAPTURE + "uvc_refuses_what_reads_back_otherwise",
            CAPTURE + "sources_that_nobody_reads",
        ),
        (
            _at_most("camera", "back", 1, "s", "frames again after the camera serves again"),
            _at_most("camera", "age", 2000 / 30, "ms", "age of a frame after a pause (two frame periods)"),
            _never("camera", "stale", "stale frames delivered, or passed as new"),
        ),
    ),
    Promise(
        "One contract",
        "A policy sees the same keys, types, shapes, units and frames on every kind of rig.",
        (
            CONTRACT + "the_spec_says_what_is_observed",
            CONTRACT + "touch_has_the_canonical_shapes_types_and_ranges",
            CONTRACT + "arms_speak_si_in_world_and_sensor_axes",
            CONTRACT + "times_run_on_one_clock",
            CONTRACT + "an_image_policy_runs_and_every_step_is_recorded",
        ),
    ),
    Promise(
        "Rate",
        "500 periods a second, also with two arms.",
        (UR + "the_loop_counts_its_periods",),
        (
            _at_most("rate", "p99", 4, "ms", "99th percentile of the period, two arms"),
            Target(
                "... of a loop that does nothing, in the same run",
                "ms",
                None,
                None,
                pick("error", "rate", "empty loop"),
            ),
            _at_most("one_instant", "look", 5, "µs", "one look at the state"),
        ),
    ),
    Promise(
        "Shutdown",
        "Closing ends soon, twice does no harm, and nothing is left; an episode survives a kill.",
        (
            UR + "nothing_is_left_after_close",
            UR + "nothing_is_left_of_a_worker_that_died",
            UR + "a_policy_that_dies_leaves_a_standing_arm_and_nothing_else",
            UR + "a_wedged_worker_is_killed",
            UR + "close_while_it_connects",
            CAMERA + "many_openings_leave_nothing",
            "tacsim/record/test_recorder.py::test_every_flushed_step_survives_a_kill",
        ),
        (
            _at_most("shutdown", "close", 1.5, "s", "close() under way"),
            _never("shutdown", "left", "processes, sockets, shared memory left by close()"),
            _never("policy_death", "left", "the same after the policy was killed"),
        ),
    ),
    Promise(
        "Two arms",
        "They keep apart whoever moves, and both stop when one does.",
        (
            UR + "two_arms_keep_apart_whoever_moves",
            UR + "both_arms_stop_when_one_does",
            UR + "a_dead_partner_stops_the_arm_that_moves",
            UR + "an_arm_waits_for_the_other_of_its_keep_out",
            SERVO + "another_arm_is_not_come_near_and_parting_is_free",
            SERVO + "the_braking_way_of_the_other_arm_counts",
        ),
        (
            _at_most("keep_out", "breach", 1, "mm", "nearer than the keep-out, head on, measured"),
            _at_most("keep_out", "skew", 4, "ms", "the second stop after the first"),
        ),
    ),
)
