"""A remover of a stranger, from a scene file."""

from instrument.pipeline.run import stream
from instrument.pipeline.scene_file import parse
from instrument.pipeline.scene_text import override, read_tables
from instrument.pipeline.stage import Running


def test_a_remover_of_a_stranger_works_from_a_scene_file(stranger):
    stranger("foregrounds", "flat-leakage", "FlatLeakage")
    tables = override(
        read_tables("mock-grid"),
        [
            "instrument.stations=['CS001HBA0', 'CS003HBA1', 'CS302HBA1', 'RS106HBA']", "sky.shape=[3, 3]",
            "observation.duration='40 min'", "observation.interval='20 min'", "image.pixels=32",
            "observation.frequency={centre='150 MHz', width='1 MHz', channels=4}", "sky.polarization=[0.1, 0.2, 0.0]",
            "analyze={cube={products=['cylindrical'], remove='flat-leakage', remover={weighted=false}}}",
        ],
    )  # fmt: skip
    file = parse(tables)
    scene = file.scene()
    running = Running(file.name, file.seed, scene.instrument, file.plan(scene), file.running)
    stream(running)
    (split,) = (part.split for part in running.results["analyze"].parts if getattr(part, "split", None) is not None)
    assert type(split.remover).__module__ == "my_package" and not split.remover.weighted
    assert "% of Q and" in split.remark
    assert any(split.remark in str(line) for line in running.results["analyze"].lines())
