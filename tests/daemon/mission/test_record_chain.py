"""The chain over records: every way of tampering but one is seen, and that one by the index."""

from __future__ import annotations

import os
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.mission.verification.chain import ChainLink, follow_chain
from tests.daemon.small_camera import new_mission

GENESIS = "g" * 64


def chain_of(numbers):
    links, previous = [], GENESIS
    for number in numbers:
        links.append(ChainLink(number, f"{number:064d}", previous))
        previous = links[-1].sha256
    return links


orders = st.permutations(range(1, 9))


@given(orders, st.randoms())
def test_a_complete_chain_is_followed_in_the_order_of_sealing(order, random):
    links = chain_of(order)
    shuffled = list(links)
    random.shuffle(shuffled)
    report = follow_chain(shuffled, GENESIS)
    assert report.problems == ()
    assert [link.number for link in report.order] == list(order)
    assert report.head_sha256 == links[-1].sha256


@given(orders, st.integers(0, 6))
def test_an_altered_record_breaks_the_chain_behind_it(order, place):
    links = chain_of(order)
    links[place] = replace(links[place], sha256="f" * 64)
    report = follow_chain(links, GENESIS)
    assert len(report.problems) == 1
    assert f"broken before exposure {links[place + 1].number}:" in report.problems[0]
    assert len(report.order) == 8 and report.head_sha256 == links[-1].sha256


@given(orders, st.integers(0, 6))
def test_a_removed_record_breaks_the_chain_behind_it(order, place):
    links = chain_of(order)
    behind = links[place + 1].number
    del links[place]
    report = follow_chain(links, GENESIS)
    assert len(report.problems) == 1
    assert f"broken before exposure {behind}:" in report.problems[0]


def test_a_record_slipped_in_forks_the_chain():
    links = chain_of([1, 2, 3])
    report = follow_chain([*links, ChainLink(4, "4" * 64, links[0].sha256)], GENESIS)
    assert "exposures 2, 4 quote the same record" in report.problems[0]


def test_a_record_that_quotes_nothing_is_no_part_of_the_chain():
    links = chain_of([1, 2])
    report = follow_chain([*links, ChainLink(3, "3" * 64, "")], GENESIS)
    assert "broken before exposure 3: it quotes nothing" in report.problems[0]


def test_an_empty_chain_begins_at_the_genesis():
    assert follow_chain([], GENESIS).head_sha256 == GENESIS


def test_a_chain_file_is_let_go_once_and_may_be_closed_again(tmp_path):
    mission = new_mission(tmp_path)
    chain = mission.open_chain()

    descriptor = chain._descriptor
    assert descriptor is not None
    chain.close()
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(descriptor)
    chain.close()
