"""Mutants of a module: each changes one place of one function, and is named by what it changes, not by its line."""

import ast
import copy
from dataclasses import dataclass

COMPARE = {
    ast.Lt: [ast.LtE, ast.GtE],
    ast.LtE: [ast.Lt, ast.Gt],
    ast.Gt: [ast.GtE, ast.LtE],
    ast.GtE: [ast.Gt, ast.Lt],
    ast.Eq: [ast.NotEq],
    ast.NotEq: [ast.Eq],
}
ARITHMETIC = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.FloorDiv,
    ast.Div: ast.Mult,
    ast.Mod: ast.Add,
    ast.FloorDiv: ast.Mult,
}
SWAPPED = {"min": "max", "max": "min"}
STATES = ("GATE_DISARMED", "GATE_ARMED", "GATE_FAULT")


@dataclass(frozen=True)
class Mutant:
    """A changed module: `name` says function and change, such as `limited: max(...) -> min(...)`."""

    name: str
    tree: ast.Module


def mutants_of(source, functions):
    """All mutants of the named functions of a module's source, in order."""
    tree = ast.parse(source)
    seen = {}
    for function in (node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name in functions):
        for path in _paths(function):
            for changed in _changes(_at(function, path)):
                before, mutated = _place(function, path, changed)
                name = f"{function.name}: {before} -> {_statement_of(mutated, path)}"
                seen[name] = seen.get(name, 0) + 1
                number = f" (#{seen[name]})" if seen[name] > 1 else ""
                yield Mutant(name + number, _with(tree, function, mutated))


def functions_of(source):
    """Names of the compiled functions of a module."""
    return [n.name for n in ast.parse(source).body if isinstance(n, ast.FunctionDef) and _is_kernel(n)]


def _is_kernel(function):
    return any("kernel" in ast.unparse(decorator) for decorator in function.decorator_list)


def _paths(function):
    """Ways (field, index or None) to every node of the body; decorator, signature and docstring are left alone."""
    start = 1 if ast.get_docstring(function) is not None else 0
    for k in range(start, len(function.body)):
        yield from _below(function.body[k], (("body", k),))


def _below(node, path):
    yield path
    for field, value in ast.iter_fields(node):
        if isinstance(value, ast.AST) and not isinstance(
            value, (ast.expr_context, ast.operator, ast.cmpop, ast.boolop, ast.unaryop)
        ):
            yield from _below(value, (*path, (field, None)))
        elif isinstance(value, list):
            for k, item in enumerate(value):
                if isinstance(item, ast.AST) and not isinstance(item, ast.cmpop):
                    yield from _below(item, (*path, (field, k)))


def _at(node, path):
    for field, k in path:
        node = getattr(node, field) if k is None else getattr(node, field)[k]
    return node


def _changes(node):
    """Changed copies of a node."""
    if isinstance(node, ast.Compare):
        for k, op in enumerate(node.ops):
            for other in COMPARE.get(type(op), []):
                changed = copy.deepcopy(node)
                changed.ops[k] = other()
                yield changed
    elif isinstance(node, ast.BoolOp):
        changed = copy.deepcopy(node)
        changed.op = ast.Or() if isinstance(node.op, ast.And) else ast.And()
        yield changed
        for k in range(len(node.values)):
            left = [copy.deepcopy(v) for i, v in enumerate(node.values) if i != k]
            yield left[0] if len(left) == 1 else ast.BoolOp(copy.deepcopy(node.op), left)
    elif isinstance(node, (ast.BinOp, ast.AugAssign)) and type(node.op) in ARITHMETIC:
        changed = copy.deepcopy(node)
        changed.op = ARITHMETIC[type(node.op)]()
        yield changed
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield copy.deepcopy(node.operand)
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
        yield ast.Constant(node.value + 1)
    elif isinstance(node, ast.Name) and node.id in STATES:
        yield from (ast.Name(other, ast.Load()) for other in STATES if other != node.id)
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in SWAPPED:
        yield from _calls(node)
    elif isinstance(node, (ast.If, ast.IfExp)):
        changed = copy.deepcopy(node)
        changed.test = ast.UnaryOp(ast.Not(), changed.test)
        yield changed
    if isinstance(node, (ast.Assign, ast.AugAssign, ast.Expr)):
        yield ast.Pass()


def _calls(node):
    changed = copy.deepcopy(node)
    changed.func.id = SWAPPED[node.func.id]
    yield changed
    for k in range(len(node.args)):
        fewer = copy.deepcopy(node)
        del fewer.args[k]
        yield fewer.args[0] if len(fewer.args) == 1 else fewer


def _place(function, path, changed):
    """The statement before the change, and the function with it."""
    mutated = copy.deepcopy(function)
    parent = _at(mutated, path[:-1])
    field, k = path[-1]
    before = _statement_of(function, path)
    if k is None:
        setattr(parent, field, changed)
    else:
        getattr(parent, field)[k] = changed
    return before, mutated


def _statement_of(function, path):
    """The innermost statement on a path, its head only where it has a body."""
    found = function
    for length in range(1, len(path) + 1):
        node = _at(function, path[:length]) if _reachable(function, path[:length]) else None
        if isinstance(node, ast.stmt):
            found = node
    return ast.unparse(found).splitlines()[0]


def _reachable(function, path):
    try:
        _at(function, path)
    except (AttributeError, IndexError):
        return False
    return True


def _with(tree, function, mutated):
    ast.fix_missing_locations(mutated)
    return ast.Module([mutated if node is function else node for node in tree.body], tree.type_ignores)
