"""Requests to a served model: one that is answered, and many that are not."""

from lw_torchrl.planners import plan_schema

SCHEMA = plan_schema("reach", "chain_py", free_skills=True)
ASKED = {"model": "mine", "messages": [{"role": "user", "content": "a plan"}], "max_tokens": 1}


def held_to(schema):
    return {
        "response_format": {"type": "json_schema", "json_schema": {"name": "plan", "schema": schema, "strict": True}}
    }


def nested(depth, inside):
    for _ in range(depth):
        inside = {"type": "array", "items": inside, "minItems": 0, "maxItems": 2}
    return inside


ITEM = {"type": "string", "enum": ["x"]}
WRONG = {
    "no messages": {"messages": []},
    "messages": {"messages": "x"},
    "too many messages": {"messages": ASKED["messages"] * 101},
    "a message": {"messages": [3]},
    "another role": {"messages": [{"role": "tool", "content": "x"}]},
    "a picture": {"messages": [{"role": "user", "content": [{"type": "image_url", "image_url": {"url": "file:///"}}]}]},
    "no content": {"messages": [{"role": "user", "content": None}]},
    "more in a message": {"messages": [{"role": "user", "content": "x", "tool_calls": []}]},
    "max_tokens beyond": {"max_tokens": 8193},
    "no max_tokens": {"max_tokens": 0},
    "max_tokens true": {"max_tokens": True},
    "max_tokens text": {"max_tokens": "9"},
    "max_tokens huge": {"max_tokens": 10**400},
    "n": {"n": 100},
    "stream": {"stream": True},
    "temperature": {"temperature": -1},
    "top_p": {"top_p": 1.5},
    "top_k": {"top_k": 1.5},
    "seed": {"seed": 2**64},
    "stops": {"stop": ["x"] * 9},
    "an empty stop": {"stop": ""},
    "a long stop": {"stop": "x" * 101},
    "a grammar": {"grammar": 'root ::= "a"{1,1000000}'},
    "tools": {"tools": [{"type": "function"}]},
    "logprobs": {"logprobs": True, "top_logprobs": 10**6},
    "logit_bias": {"logit_bias": {"1": 100}},
    "best_of": {"best_of": 1000},
    "a field": {"x" * 1000: 1},
    "a format": {"response_format": {"type": "grammar"}},
    "a format that is a list": {"response_format": []},
    "no schema": {"response_format": {"type": "json_schema", "json_schema": {}}},
    "a schema that is a list": held_to([]),
    "a schema of anything": held_to({}),
    "a reference": held_to({"$ref": "https://127.0.0.1/schema"}),
    "items without an end": held_to({"type": "array", "items": ITEM, "minItems": 1, "maxItems": 10**9}),
    "items without a limit": held_to({"type": "array", "items": ITEM}),
    "a pattern": held_to({"type": "string", "pattern": "^((a{64}){64}){64}$"}),
    "a pattern that is a list": held_to({"type": "string", "pattern": ["x"]}),
    "a pattern that is an object": held_to({"type": "string", "pattern": {}}),
    "messages null": {"messages": None},
    "a long text": held_to({"type": "string", "minLength": 10**9}),
    "choices": held_to({"type": "string", "enum": ["x"] * 1001}),
    "a schema nested deep": held_to(nested(20, ITEM)),
    "a schema nested very deep": held_to(nested(90, ITEM)),
}
