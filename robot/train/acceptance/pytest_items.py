"""The options of the pytest plug-in, and the one test of a session: `pytest_tacsim` loads this module for --policy."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from robot.train.acceptance.accept import Acceptance

REPORT = pytest.StashKey[Any]()  # of the acceptance, once it is done


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("tacsim", "acceptance of a policy (tacsim, docs/acceptance.md)")
    option = group.addoption
    option("--policy", metavar="POLICY", help="FILE.onnx, module:Class, learned, scripted ...")
    option("--task", metavar="TASK", help="A task of the benchmark (tacsim benchmark tasks), or the path of a file.")
    option("--against", metavar="POLICY", help="An earlier policy: POLICY must not be worse by --indifference.")
    option("--rig", choices=("sim", "mock"), default="sim", help="mock: over the real wire on loopback.")
    option("--split", metavar="NAME", default="test", help="test, or a shift of the task. Default: test")
    option("--success", metavar="RATE", type=float, default=0.9, help="Rate of a good policy. Default: 0.9")
    option("--indifference", metavar="RATE", type=float, default=0.2, help="Worse by this is too bad. Default: 0.2")
    option("--alpha", type=float, default=0.05, help="Probability to accept what is too bad. Default: 0.05")
    option("--beta", type=float, default=0.05, help="Probability to reject what is good. Default: 0.05")
    option("--max-episodes", type=int, default=100, metavar="N", help="Then it is undecided. Default: 100")


def _read_options(config: pytest.Config) -> Acceptance:
    """Raises pytest.UsageError."""
    from robot.train.acceptance.accept import Acceptance, load_checked_split
    from robot.train.acceptance.sequential import Errors

    given: Any = config.option
    if given.task is None:
        raise pytest.UsageError("--policy needs a task: --task squeeze; tacsim benchmark tasks lists them")
    if config.args_source is pytest.Config.ArgsSource.ARGS:
        raise pytest.UsageError(
            f"with --policy pytest tests the policy alone, but '{config.args[0]}' is named too: run your tests by a "
            "call of their own"
        )
    if getattr(given, "numprocesses", None):
        raise pytest.UsageError("a sequential test is one process: leave out -n")
    try:
        request = Acceptance(
            policy=given.policy,
            task=given.task,
            against=given.against,
            rig=given.rig,
            split=given.split,
            success=given.success,
            indifference=given.indifference,
            errors=Errors(given.alpha, given.beta),
            max_episodes=given.max_episodes,
        )
        load_checked_split(request)
    except ValueError as failure:
        raise pytest.UsageError(str(failure)) from None
    return request


@pytest.hookimpl(tryfirst=True)
def pytest_collection(session: pytest.Session) -> bool:
    """In place of the tests of the folder: the acceptance of the policy."""
    config = session.config
    request = _read_options(config)
    item = AcceptanceItem.from_parent(session, name=f"{request.policy} on {request.task}", request=request)
    if config.pluginmanager.hasplugin("timeout"):
        item.add_marker(pytest.mark.timeout(0))  # a limit for unit tests; --max-episodes ends this one
    session.items = [item]
    session.testscollected = 1
    config.hook.pytest_collectreport(report=pytest.CollectReport(session.nodeid, "passed", None, [item]))
    config.hook.pytest_collection_finish(session=session)
    return True


class AcceptanceItem(pytest.Item):
    """The acceptance of one policy."""

    def __init__(self, *, request: Acceptance, **rest: Any) -> None:
        super().__init__(**rest)
        self._request = request

    def runtest(self) -> None:
        """Raises NotAccepted, and pytest.UsageError for what cannot be done."""
        from robot.train.acceptance.accept import BadRequest, accept_policy
        from robot.train.acceptance.words import describe_report
        from robot.train.benchmark.wire import RigFailed
        from tacsim.config import ConfigError

        try:
            report = accept_policy(self._request)
        except (BadRequest, ConfigError) as failure:
            raise CannotTest(f"cannot begin, nothing is said of the policy: {failure}") from None
        except RigFailed as failure:
            raise CannotTest(
                f"the rig failed, nothing is said of the policy: {failure}\nDo next: run it again; if it happens again "
                "without load, tacsim doctor --rig mock"
            ) from None
        self.config.stash[REPORT] = report
        self.user_properties += [
            ("verdict", report.verdict),
            ("cause", report.cause),
            ("episodes", report.test.count),
            ("evidence", round(report.test.evidence, 4)),
        ]
        if report.verdict != "accepted":
            raise NotAccepted(describe_report(report))

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        if isinstance(excinfo.value, NotAccepted | CannotTest):
            return str(excinfo.value)
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Any, int | None, str]:
        return self.path, None, self.name


class NotAccepted(AssertionError):
    """The policy is rejected, or undecided."""


class CannotTest(RuntimeError):
    """The acceptance could not be done."""


@pytest.hookimpl(wrapper=True)
def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> Iterator[None]:
    """An accepted policy has a report, too."""
    from robot.train.acceptance.words import describe_report

    report = terminalreporter.config.stash.get(REPORT, None)
    if report is not None and report.verdict == "accepted":
        terminalreporter.section("acceptance of a policy")
        terminalreporter.line(describe_report(report))
    return (yield)
