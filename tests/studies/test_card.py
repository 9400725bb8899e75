"""Policy cards: the header that other programs read, figures of the files, hostile texts."""

import json

import pytest

from equipoise.artefacts import Provenance
from equipoise.errors import InputError
from equipoise.evaluation import evaluate
from equipoise.studies.card import card, literal, read_evidence
from equipoise.studies.certification import certify, evaluation_path, make_claim

yaml = pytest.importorskip("yaml")


@pytest.fixture(scope="module")
def evaluation(small_policy):
    length = {"trials": 4, "duration": 0.5}
    chosen = small_policy.settings.evaluation.model_copy(update=length)
    settings = small_policy.settings.model_copy(update={"evaluation": chosen})
    return evaluate(small_policy, settings, world="model")


@pytest.fixture(scope="module")
def refused(small_policy):
    """A claim that an untrained policy does not keep, and its trials."""
    return certify(small_policy, make_claim(0.5, duration=60.0, trials=10))


def made(policy, *evidence, name="balancer"):
    return card(policy, Provenance.now("test", {}), evidence, name=name)


def header(text):
    start, head, _ = text.split("---\n", 2)
    assert start == ""
    return yaml.safe_load(head)


def test_the_header_is_that_of_a_model_card(small_policy, evaluation, refused):
    head = header(made(small_policy, evaluation, refused[0]))
    assert head["library_name"] == "equipoise"
    (model,) = head["model-index"]
    assert model["name"] == "balancer"
    survival, bound = (result["metrics"][0] for result in model["results"])
    assert survival["value"] == evaluation.results.summary().rate
    assert bound["value"] == refused[0].bound
    assert [result["dataset"]["name"] for result in model["results"]] == ["model", "model"]


def test_without_trials_it_says_so(small_policy):
    text = made(small_policy)
    assert "Nobody has tested it" in text
    assert "model-index" not in header(text)


def test_a_refused_claim_is_told_twice(small_policy, refused):
    text = made(small_policy, refused[0])
    assert "| claim **refused** |" in text
    assert "- The claims that are refused above." in text


def test_texts_of_others_stay_texts(small_policy):
    name = 'a"b: [x](http://y) | <script>\n---\n# head\x1b[2J *bold*'
    text = made(small_policy, name=name)
    assert "\x1b" not in text
    assert "<script>" not in text
    assert "\n# head" not in text
    assert literal("a|b_c [d](e) \n") == "a\\|b\\_c \\[d\\](e) \\\\n"
    evaluated = header(made(small_policy, name=name))
    assert "model-index" not in evaluated


def test_a_name_cannot_leave_the_header(small_policy, evaluation):
    name = "x\n---\nlicense: mit"
    assert header(made(small_policy, evaluation, name=name))["model-index"][0]["name"] == name


def test_evidence_is_of_this_policy_and_intact(small_policy, evaluation, refused, tmp_path):
    evaluation.save(tmp_path / "evaluation.json", command="test")
    assert read_evidence(tmp_path / "evaluation.json", small_policy) == evaluation
    other = small_policy.model_copy(update={"seed": small_policy.seed + 1})
    with pytest.raises(InputError, match="is of another policy"):
        read_evidence(tmp_path / "evaluation.json", other)
    small_policy.save(tmp_path / "policy.json", command="test")
    with pytest.raises(InputError, match="expected an evaluation or a certificate"):
        read_evidence(tmp_path / "policy.json", small_policy)
    path = tmp_path / "certificate.json"
    refused[0].save(path, command="test")
    evaluation.save(evaluation_path(path), command="test")
    with pytest.raises(InputError):  # the trials beside it are others
        read_evidence(path, small_policy)


@pytest.mark.slow
def test_hugging_face_reads_it(small_policy, evaluation):
    hub = pytest.importorskip("huggingface_hub")
    found = hub.ModelCard(made(small_policy, evaluation))
    assert found.data.library_name == "equipoise"
    (result,) = found.data.eval_results
    assert result.metric_value == evaluation.results.summary().rate
    assert json.loads(json.dumps(found.data.to_dict()))["tags"][0] == "reinforcement-learning"
