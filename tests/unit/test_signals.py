"""Whether Slurm has told a job to make room, with a stand-in for scontrol; the real one is asked by `make cluster`."""

import pytest

from srlrace.signals import preempted

JOB = (
    "JobId=7 JobName=srlrace JobState={} Reason=None PreemptEligibleTime=2026-01-01T00:00:00 PreemptTime={} Comment=a b"
)


@pytest.fixture
def scontrol(tmp_path, monkeypatch):
    """Make scontrol answer with this text, in a job of submitit's."""

    def answer(text, status=0):
        program = tmp_path / "scontrol"
        program.write_text(f"#!/bin/sh\necho '{text}'\ntest \"$*\" = '--oneliner show job 7' && exit {status}\n")
        program.chmod(0o755)

    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("SLURM_JOB_ID", "7")
    monkeypatch.setenv("SUBMITIT_EXECUTOR", "slurm")
    return answer


def test_a_job_with_time_of_grace(scontrol):
    scontrol(JOB.format("RUNNING", "2026-01-01T00:01:00"))
    assert preempted()


@pytest.mark.parametrize(
    ("state", "since"),
    [("RUNNING", "None"), ("COMPLETING", "2026-01-01T00:01:00"), ("CANCELLED", "None")],
)
def test_jobs_that_were_told_to_stop_for_another_reason(scontrol, state, since):
    scontrol(JOB.format(state, since))
    assert not preempted()


def test_without_an_answer(scontrol, monkeypatch):
    assert not preempted()  # no scontrol here
    scontrol(JOB.format("RUNNING", "2026-01-01T00:01:00"), status=1)
    assert not preempted()
    scontrol(JOB.format("RUNNING", "2026-01-01T00:01:00"))
    monkeypatch.delenv("SUBMITIT_EXECUTOR")  # a script of the user's own decides itself
    assert not preempted()
