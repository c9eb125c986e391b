from app.viewer.panels.panel import status


def test_a_sentence_says_what_it_is_about_and_brings_no_markup_of_its_own():
    line = status("push", "<script>alert(1)</script> & co")
    assert 'class="push-status"' in line
    assert "<script" not in line
    assert "&amp; co" in line
