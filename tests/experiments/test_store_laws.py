"""Test with random actions of workers: each run has one result, from the worker that last held it."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any
from unittest import mock

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, consumes, invariant, rule

from lapgs_bench.experiments import store as store_module
from lapgs_bench.experiments.store import DONE, FAILED, LEASE, MAX_CLAIMS, RUNNING, Claim, Job, ResultStore
from tests.experiments.examples import run_spec

RUNS = 3


class Workers(RuleBasedStateMachine):
    """Random claims that are renewed, recorded, failed, released, or expire."""

    claims = Bundle("claims")

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()
        self.now = 1e9
        self.clock = mock.patch.object(store_module.time, "time", self.read_clock)
        self.clock.start()
        self.jobs = [Job(f"run{i}", run_spec(i), "", "", (), True, "{}") for i in range(RUNS)]
        self.store = ResultStore.create(Path(self.folder.name) / "results.sqlite")
        self.store.plan(self.jobs)
        self.holder: dict[str, Claim] = {}
        self.until: dict[str, float] = {}
        self.written: dict[str, Any] = {}

    def read_clock(self) -> float:
        return self.now

    def teardown(self) -> None:
        self.clock.stop()
        self.folder.cleanup()

    def holds(self, claim: Claim) -> bool:
        return self.holder.get(claim.job.run_id) is claim

    @rule(target=claims)
    def claim(self) -> Any:
        claim = self.store.claim([job.run_id for job in self.jobs])
        if claim is None:
            return None
        run_id = claim.job.run_id
        assert run_id not in self.written, "what is finished is never run again"
        if run_id in self.holder:
            assert self.now > self.until[run_id], "what somebody holds is not given away"
        self.holder[run_id], self.until[run_id] = claim, self.now + LEASE
        assert claim.number <= MAX_CLAIMS
        return claim

    @rule(claim=claims)
    def renew(self, claim: Claim | None) -> None:
        if claim is not None:
            assert self.store.renew(claim) == self.holds(claim)
            if self.holds(claim):
                self.until[claim.job.run_id] = self.now + LEASE

    @rule(claim=consumes(claims), well=st.booleans())
    def finish(self, claim: Claim | None, well: bool) -> None:
        if claim is None:
            return
        row = {"owner": claim.owner}
        taken = self.store.record(claim, row) if well else self.store.fail(claim, claim.owner)
        assert taken == self.holds(claim)
        if taken:
            self.written[claim.job.run_id] = row if well else None
            del self.holder[claim.job.run_id]

    @rule(claim=consumes(claims))
    def give_back(self, claim: Claim | None) -> None:
        if claim is not None:
            self.store.release(claim)
            if self.holds(claim):
                del self.holder[claim.job.run_id]

    @rule(leases=st.sampled_from((0.5, 1.01)))
    def time_passes(self, leases: float) -> None:
        self.now += leases * LEASE

    @invariant()
    def the_store_says_what_happened(self) -> None:
        for outcome in self.store.outcomes():
            if outcome.run_id in self.written:
                assert outcome.record == self.written[outcome.run_id]
                assert outcome.state == (DONE if outcome.record else FAILED)
            elif outcome.run_id in self.holder and outcome.state != FAILED:
                assert outcome.state == RUNNING
            elif outcome.state == FAILED:
                assert "died" in outcome.error
                self.holder.pop(outcome.run_id, None)
                self.written[outcome.run_id] = None


Workers.TestCase.settings = settings(deadline=None, max_examples=15, stateful_step_count=25)
TestWorkers = Workers.TestCase
