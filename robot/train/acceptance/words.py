"""A report in words: what was found, of what a failure is, and what to do next."""

from __future__ import annotations

from robot.train.acceptance.accept import Report
from robot.train.acceptance.sequential import PairedTest, RateTest
from robot.train.benchmark.policies import ANALYTIC, BLIND, RANDOM, TEACHER
from robot.train.evaluate import wilson_interval

MAX_NUMBERS = 12  # of episodes that are listed
MAX_NOTE = 300  # characters


def describe_report(report: Report) -> str:
    """All lines of a report."""
    lines = [_verdict_line(report), *_result_lines(report)]
    if report.verdict != "accepted":
        lines += _cause_lines(report)
        lines += ["Do next:", *(f"  - {each}" for each in _advice(report))]
    return "\n".join(lines)


def _verdict_line(report: Report) -> str:
    request = report.request
    subject = f"policy '{request.policy}', task {request.task}, split {request.split}, rig {request.rig}"
    if report.verdict == "accepted":
        return f"accepted: {subject}"
    if report.verdict == "undecided":
        return f"undecided, so not accepted: {subject}"
    known = any(each.outside is not None for each in report.misses)
    of = {
        "contract": "the contract (the policy does not fit, raises, or gives no action)",
        "physics": "the physics (the episodes leave the range of its training)",
    }.get(report.cause, f"the policy (it misses{' within the range of its training' if known else ''})")
    return f"rejected, a failure of {of}: {subject}"


def _result_lines(report: Report) -> list[str]:
    test, request, errors = report.test, report.request, report.test.errors
    if report.contract_error:
        return [report.contract_error]
    lines = []
    if isinstance(test, RateTest) and test.count:
        rate = wilson_interval(test.successes, test.count)
        lines.append(
            f"{test.successes} of {test.count} episodes succeed: {100 * rate.value:.0f} % ({100 * rate.low:.0f} to "
            f"{100 * rate.high:.0f})"
        )
        lines.append(
            f"asked: {100 * request.success:g} %; too bad: {100 * (request.success - request.indifference):g} % or less"
        )
    elif isinstance(test, PairedTest):
        lines.append(
            f"{test.count} episodes: this policy alone reaches {test.won} goals, '{request.against}' alone {test.lost}"
        )
        lines.append(f"asked: as good as '{request.against}'; too bad: lower by {100 * request.indifference:g} points")
    lines.append(
        f"evidence {test.evidence:.2f}, accepts at {errors.upper:.2f}, rejects at {errors.lower:.2f} (alpha "
        f"{errors.alpha:g}, beta {errors.beta:g})"
    )
    idle = [each for each in report.played if not each.has_begun]
    if idle:
        lines.append(f"not counted, the reset failed: {_numbers([each.number for each in idle])} ({idle[0].reason})")
    return lines


def _cause_lines(report: Report) -> list[str]:
    if report.cause == "contract":
        return []
    misses = report.misses
    groups = (
        ("missed outside the range of the training (training_distance > 1)", [e for e in misses if e.outside]),
        ("missed within the range of the training", [e for e in misses if e.outside is False]),
        ("missed, range of the training unknown", [e for e in misses if e.outside is None]),
    )
    lines = [f"{words}: {_numbers([each.number for each in found])}" for words, found in groups if found]
    ended = [each for each in misses if each.reason]
    if ended:
        lines.append(f"episode {ended[0].number} ended early: {ended[0].reason}")
    return [*lines, *(_short(note) for note in report.notes)]


def _advice(report: Report) -> list[str]:
    request = report.request
    name = request.task
    again = f"tacsim benchmark run {name} --split {request.split} --policy {request.policy}"
    if report.cause == "contract":
        return [
            "read the line above: it names the sensor, axis, period, number or error",
            "correct the policy, or train and export it for this rig and task; `tacsim run --policy` shows the same",
        ]
    by_cause = [f"look at these episodes: {again}"]
    if report.cause == "physics":
        by_cause += [
            "train with wider ranges (`randomise` in the training file), so that these episodes are inside, or",
            "ask for less: keep such bodies and sensors away from this policy",
        ]
    elif request.policy not in (RANDOM, BLIND, ANALYTIC, TEACHER):
        by_cause += ["compare with the teacher there (--policy teacher): what it misses, no policy reaches"]
        by_cause += ["train longer, with more draws, or with other features (docs/train.md)"]
    if report.verdict == "undecided":
        return [
            f"{report.test.count} episodes lie between good and too bad: raise --max-episodes, or",
            "raise --indifference for a coarser answer in fewer episodes",
            *by_cause,
        ]
    return by_cause


def _numbers(numbers: list[int]) -> str:
    shown = ", ".join(map(str, numbers[:MAX_NUMBERS]))
    more = f" and {len(numbers) - MAX_NUMBERS} more" if len(numbers) > MAX_NUMBERS else ""
    return f"{len(numbers)} (episode{'s' * (len(numbers) > 1)} {shown}{more})"


def _short(note: str) -> str:
    return note if len(note) <= MAX_NOTE else f"{note[: MAX_NOTE - 4]} ..."
