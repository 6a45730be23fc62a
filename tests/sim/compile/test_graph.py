"""What scalars simplify to, and in which order and how often they are computed."""

import numpy as np
import pytest

from jaxbiped.sim.compile import fold
from jaxbiped.sim.compile.graph import Graph
from jaxbiped.sim.compile.program import Level, Program, Word

assert fold
F, WHOLE, B = np.dtype(float), np.dtype(np.int32), np.dtype(bool)


@pytest.fixture
def graph() -> Graph:
    return Graph()


def test_equal_operations_are_one_node(graph: Graph):
    x, y = graph.input(0, 0, F), graph.input(0, 1, F)
    assert graph.op("add", F, x, y) is graph.op("add", F, y, x)
    assert graph.op("sub", F, x, y) is not graph.op("sub", F, y, x)


def test_known_numbers_are_computed_at_once(graph: Graph):
    assert graph.op("mul", F, F.type(3), F.type(4)) == 12.0
    assert graph.op("div", WHOLE, WHOLE.type(-7), WHOLE.type(2)) == -3
    assert graph.op("rem", WHOLE, WHOLE.type(-7), WHOLE.type(2)) == -1
    assert graph.op("convert", WHOLE, F.type(np.nan)) == 0
    assert not graph.nodes


def test_zeros_and_ones_vanish(graph: Graph):
    x, zero, one = graph.input(0, 0, F), F.type(0), F.type(1)
    for same in (("add", zero, x), ("add", x, zero), ("sub", x, zero), ("mul", one, x), ("div", x, one)):
        assert graph.op(same[0], F, *same[1:]) is x
    assert graph.op("mul", F, x, zero) == 0.0 and graph.op("div", F, zero, x) == 0.0
    assert graph.op("sub", F, zero, x).op == "neg" and graph.op("mul", F, x, F.type(-1)).op == "neg"
    assert graph.op("div", F, x, F.type(4)).op == "mul" and graph.op("div", F, x, F.type(3)).op == "div"


def test_signs_move_into_sums_and_out_of_products(graph: Graph):
    x, y = graph.input(0, 0, F), graph.input(0, 1, F)
    less = graph.op("neg", F, y)
    assert graph.op("add", F, x, less) is graph.op("sub", F, x, y)
    assert graph.op("sub", F, x, less) is graph.op("add", F, x, y)
    assert graph.op("neg", F, less) is y
    assert graph.op("mul", F, graph.op("neg", F, x), less) is graph.op("mul", F, x, y)


def test_choices_of_what_is_known_vanish(graph: Graph):
    which, other, x = graph.input(0, 0, B), graph.input(0, 1, B), graph.input(0, 2, F)
    assert graph.op("select", F, np.True_, F.type(1), x) is x
    assert graph.op("select", F, which, x, x) is x
    assert graph.op("select", B, which, np.False_, np.True_) is which
    assert graph.op("select", B, which, np.False_, other) is graph.op("and", B, which, other)
    assert graph.op("select", B, which, other, np.True_) is graph.op("or", B, which, other)
    flipped = graph.op("select", F, graph.op("not", B, which), F.type(2), x)
    assert flipped is graph.op("select", F, which, x, F.type(2))
    assert graph.op("and", B, which, np.False_) == np.False_ and graph.op("or", B, np.False_, which) is which


def test_only_what_is_needed_is_computed_and_each_as_often_as_it_changes(graph: Graph):
    mass, load, speed = graph.input(0, 0, F), graph.input(1, 0, F), graph.input(2, 0, F)
    twice = graph.op("mul", F, mass, F.type(2))
    all_of_it = graph.op("add", F, twice, load)
    faster = graph.op("mul", F, all_of_it, speed)
    dead = graph.op("sin", F, speed)
    words = [Word(1, 0, F), Word(2, 0, F)]
    program = Program(graph, words, [load, faster], np.False_)
    assert dead not in program.order
    assert program.at(Level.SHARED) == [mass, twice] and program.kept(Level.SHARED) == [twice]
    assert program.at(Level.LANE) == [load, all_of_it]
    assert set(program.at(Level.TICK)) == {speed, faster}
    assert program.changing == [1]
