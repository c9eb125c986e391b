from app.api.schemas.fields import FieldOut, SetOut
from app.services.image_sets import SetRecord


def test_a_set_says_what_the_store_says():
    record = SetRecord("a1", "mug.zip", "2026-01-01T00:00:00.000Z", 260, 40, "300 images")
    assert SetOut.of(record).model_dump()["train"] == 260


def test_metrics_that_are_no_numbers_go_out_as_null():
    out = FieldOut(
        name="a",
        label="A",
        source="trained",
        bytes=1,
        metrics={"psnr_full": float("nan")},
        published=None,
        has_mesh=True,
        note=None,
    )
    assert '"psnr_full":null' in out.model_dump_json()
