"""The options of policies and critics that type checkers see are those that there are."""

from __future__ import annotations

from inspect import signature, unwrap
from typing import ForwardRef

import pytest

import lw_torchrl as lw
from lw_torchrl.modules import QValue
from lw_torchrl.modules import options as stated


@pytest.mark.parametrize(
    ("made", "options"),
    [
        (lw.PlanConditionedActor, stated.PlanActorOptions),
        (lw.DescriptorConditionedActor, stated.DescriptorActorOptions),
        (QValue, stated.CriticOptions),
        (lw.PlanConditionedValue, stated.PlanValueOptions),
        (lw.PlanConditionedQValue, stated.PlanQValueOptions),
    ],
)
def test_type_checkers_see_every_option(made, options):
    taken = {name: one.annotation for name, one in signature(made.__init__).parameters.items()}
    own = signature(unwrap(made.__init__)).parameters
    told = {name: kind for name, kind in options.__annotations__.items()}
    assert all(isinstance(kind, ForwardRef) for kind in told.values())
    assert {name: kind for name, kind in taken.items() if name not in own} == {
        name: kind.__forward_arg__ for name, kind in told.items()
    }
