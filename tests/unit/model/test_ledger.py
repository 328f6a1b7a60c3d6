"""Ledger of what each principal stores, and sizes of values."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rosrm.model.ledger import BOUNDS, Amount, Ledger, Store, bound_of
from rosrm.model.sizes import size_of
from rosrm.model.values import ProcessSpec, StopPolicy

actions = st.lists(
    st.tuples(st.sampled_from("ab"), st.integers(0, 5), st.one_of(st.none(), st.integers(0, 9)))
)


@given(actions)
def test_totals_are_the_sums_of_the_entries(found: list[tuple[str, int, int | None]]) -> None:
    """The sum is the same whatever is added, replaced and removed."""
    ledger, kept = Ledger[int](), dict[tuple[str, int], int]()
    for principal, key, size in found:
        if size is None:
            ledger.remove(principal, key)
            kept.pop((principal, key), None)
        else:
            ledger.put(principal, key, size)
            kept[principal, key] = size
    for principal in "ab":
        own = [size for (owner, _), size in kept.items() if owner == principal]
        assert ledger.of(principal) == Amount(len(own), sum(own))
    assert sum(map(len, ledger.items().values())) == len(kept)


@given(st.lists(st.integers(0, 9), min_size=1), st.integers(1, 9), st.integers(0, 30))
def test_the_oldest_entries_go_until_the_rest_is_within_the_bound(
    sizes: list[int], number: int, size: int
) -> None:
    """The newest entry stays, however large it is."""
    ledger = Ledger[int]()
    for key, one in enumerate(sizes):
        ledger.put("a", key, one)
    for key in ledger.beyond("a", Amount(number, size)):
        ledger.remove("a", key)
    rest = list(ledger.items()["a"].values())
    assert rest == sizes[len(sizes) - len(rest) :]
    assert len(rest) == 1 or (len(rest) <= number and sum(rest) <= size)


def test_every_store_has_a_bound_by_role() -> None:
    """An operator may store at least as much as a user."""
    assert set(BOUNDS) == set(Store)
    for store in Store:
        user, operator = (bound_of(store, is_operator=one) for one in (False, True))
        assert 0 < user.number <= operator.number
        assert user.size <= operator.size


def test_the_size_of_a_spec_counts_all_its_texts() -> None:
    """Texts, keys and entries count, also in nested values; defaults do not."""
    assert size_of(ProcessSpec("p")) == len("p") + 1  # `ros` becomes False
    large = ProcessSpec(
        "p", command=("x" * 1000,), parameters={"a": {"b": ["y" * 1000]}},
        environment={"K" * 1000: "z" * 1000}, stop=StopPolicy(1.0),
    )  # fmt: skip
    assert 4000 <= size_of(large) <= 4050
