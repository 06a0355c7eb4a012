"""Random conditions as trees, their English, and their truth by direct interpretation."""

from hypothesis import strategies as st

from lw_torchrl.language.expressions import Once, all_of, any_of, fold, negate
from lw_torchrl.language.queries import Query, parse_query, supported_queries


def trees(leaves, most=12):
    """Return a strategy of trees ("all" | "any", parts), ("not", part) or leaf, with at most ``most`` leaves."""
    joined = lambda inner: st.tuples(st.sampled_from(["all", "any"]), st.lists(inner, min_size=1, max_size=4))  # noqa: E731
    return st.recursive(leaves, lambda inner: joined(inner) | st.tuples(st.just("not"), inner), max_leaves=most)


def visit_with_memory(truth, latched):
    """Return a function for ``fold`` that interprets an expression, and adds the latches that become true to a set."""

    def visit(each, parts):
        if each.kind != "leaf":
            return all(parts) if each.kind == "all" else any(parts)
        if not isinstance(each.leaf, Once):
            return truth[each.leaf] != each.negated
        if fold(each.leaf.condition, visit):
            latched.add(each.leaf)
        return (each.leaf in latched) != each.negated

    return visit


def interpret(tree, truth):
    """Return the truth of a tree, given a function from leaves to their truth; works with bool and with tensors."""
    if isinstance(tree, str):
        return truth(tree)
    operator, parts = tree
    if operator == "not":
        return ~interpret(parts, truth)
    result, *others = [interpret(part, truth) for part in parts]
    for other in others:
        result = result & other if operator == "all" else result | other
    return result


def build(tree, leaf=str):
    """Build the expression of a tree, given a function from the texts of leaves to expressions."""
    if isinstance(tree, str):
        return leaf(tree)
    operator, parts = tree
    if operator == "not":
        return negate(build(parts, leaf))
    return (all_of if operator == "all" else any_of)([build(part, leaf) for part in parts])


def query_of(tree, task):
    """Build the query of a tree whose leaves are texts of clauses."""
    return Query(build(tree, lambda text: parse_query(text, task).expression))


def tower(task, levels=30, width=64):
    """Return an expression with ``width`` alternatives at each level, whose text has exponential length."""
    clauses = [parse_query(text, task).expression for text in supported_queries(task)[: 2 * width : 2]]
    tip = clauses[0]
    for _ in range(levels):
        tip = negate(all_of([any_of([tip, clause]) for clause in clauses]))
    return tip


def text_of(tree):
    """Write a tree with a parenthesis around each part."""
    if isinstance(tree, str):
        return tree
    operator, parts = tree
    if operator == "not":
        return f"not ({text_of(parts)})"
    return (" and " if operator == "all" else " or ").join(f"({text_of(part)})" for part in parts)
