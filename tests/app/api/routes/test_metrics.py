def test_the_figures_are_plain_text_for_prometheus(service):
    answer = service.get("/api/metrics")
    assert answer.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
    assert answer.text.startswith("# HELP")
    assert "osf_uptime_seconds" in answer.text
