"""`equipoise card`."""

import json


def test_a_card_is_written_beside_the_policy(equipoise, policy_file, tmp_path):
    ran = equipoise("card", policy_file, "--name", "balancer")
    assert ran.code == 0, ran
    (written,) = tmp_path.glob("*-card.md")
    text = written.read_text(encoding="utf-8")
    assert text.startswith("---\nlibrary_name:")
    assert "# balancer\n" in text
    assert f"equipoise evaluate {policy_file.name} --world twin:nominal" in text
    again = equipoise("card", policy_file, "--out", written.name)
    assert again.code == 2
    assert "--force" in again.err


def test_evidence_of_another_kind_is_refused(equipoise, policy_file, tmp_path):
    ran = equipoise("card", policy_file, policy_file, "--json")
    assert ran.code == 2
    assert "expected an evaluation or a certificate" in ran.err + json.dumps(ran.out)
    assert not list(tmp_path.glob("*-card.md"))
