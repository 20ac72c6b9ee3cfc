"""The report: one page that needs no other file, with text escaped and pictures embedded."""

import base64
from html.parser import HTMLParser

from octn_ros.demo.report import NOTE, ReportPicture, render_report
from octn_ros.demo.result import DemoResult

VOID = {"meta", "img", "br", "hr", "link"}


class Page(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.open, self.images, self.links = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)
        attributes = dict(attrs)
        if tag == "img":
            self.images.append(attributes["src"])
            assert attributes["alt"]
        self.links += [value for key, value in attrs if key in ("href", "src") and not value.startswith("data:")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def made_result(**changes):
    values = {
        "source": "phantom wavy",
        "fit_s": 30.0,
        "steps": 700,
        "psnr_db": 30.5,
        "psnr_truth_db": 37.25,
        "gaussian_psnr_truth_db": 36.5,
        "psnr_bscans": 16,
        "bscans": 128,
        "requested": 3721,
        "waypoints": 3700,
        "given_up": 21,
        "hit_rate": 0.985,
        "tau": 0.41,
        "smoothness_mm2": 0.0123,
        "rms_error_um": 8.4,
        "offset_um": -1.5,
        "spread_um": 8.2,
        "max_error_um": 31.0,
        "method": "Newton",
        "executed": 3700,
        "arm_time_factor": 20.0,
        "field_hash": "0123456789abcdef",
        "report": "report.html",
        "seconds": {"scan": 2.0, "fit": 30.0},
    }
    return DemoResult(**(values | changes))


def test_the_page_stands_alone_and_holds_the_pictures():
    pictures = [ReportPicture("View <from> above", "Depth & path", b"\x89PNG-one"), ReportPicture("Fit", "", b"two")]
    text = render_report("octn demo", made_result().rows(), pictures, {"fit": {"alpha": 0.2}}, {"octn_ros": "0.1.0"})
    page = Page(text)
    assert page.open == []
    assert page.links == []
    assert [base64.b64decode(src.partition(",")[2]) for src in page.images] == [b"\x89PNG-one", b"two"]
    assert "View &lt;from&gt; above" in text
    assert "Depth &amp; path" in text
    assert NOTE in text
    assert "&quot;alpha&quot;: 0.2" in text
    assert "98.5 % within 5 % of tau = 0.410" in text
    assert "16 of 128 B-scans" in text


def test_a_recording_has_no_truth_and_says_so():
    unknown = dict.fromkeys(
        ("psnr_truth_db", "gaussian_psnr_truth_db", "rms_error_um", "offset_um", "spread_um", "max_error_um")
    )
    rows = dict(made_result(**unknown).rows())
    assert rows["RMS distance to the true surface"] == "unknown for a recording"
    assert rows["PSNR against the measured voxels"].startswith("30.50 dB")
    assert made_result(**unknown).to_plain()["rms_error_um"] is None
