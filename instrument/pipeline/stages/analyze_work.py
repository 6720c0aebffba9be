"""What the stage [analyze] costs: fluxes of sources, leakage expected, 2D spectra, and what is made of the cube."""

from __future__ import annotations

from instrument.analyze.sources.blanks import CHUNKS, PLACES
from instrument.analyze.sources.photometry import MOST_DIRECT, PRODUCTS, ROWS, ForcedPhotometry
from instrument.pipeline.stage import Running
from instrument.pipeline.stages.cube import CubeAnalysis
from instrument.pipeline.work import StageWork

TURNS = 25.0  # of conjugate gradients, where they are needed: their usual number
EXPECTED = 704.0  # bytes of a station and source where the expected leakage is worked out, one integration at a time
DEFAULT_DEPTHS = 500  # where the band decides


def photometry(settings: ForcedPhotometry, run: Running, jones: float) -> StageWork:
    """Fluxes of all sources, and their expected leakage from at most `jones` station matrices."""
    problem = run.plan.problem
    times, channels, baselines = problem.shape
    stations, sources = problem.at.shape[2:]
    slots = channels * -(-times // settings.every)
    wide = sources + PLACES
    product = 8.0 * stations**2 * wide / 2.5e10
    fringes = 3e-9 * stations * wide
    each = fringes + 4 * product + 2e-7 * baselines + 3e-4
    full = sources <= MOST_DIRECT
    plain = full and settings.uv_range is None
    last = slots * (fringes + 4.0 * stations * sources * wide / 2.5e10 + 2e-9 * sources * wide) if plain else 0.0
    if not plain:
        last = TURNS * slots * (2 * fringes + 8 * product)
        last += min(PRODUCTS, 1.0 * slots * baselines * sources**2) / 1.2e10 if full else 0.0
    solve = (sources / 1000.0) ** 3 * 0.03 if full else 0.0
    matrices = min(jones, float(stations * sources * times))
    return StageWork(
        f"fluxes of {sources} sources",
        seconds=slots * each,
        finish_seconds=last + solve + 0.65e-6 * matrices,
        held_bytes=slots * (24.0 * stations + 8 * 4 * PLACES + 600 + (0 if plain else 8.0 * baselines)),
        block_bytes=16.0 * 2 * stations * wide + 64.0 * 4 * baselines,
        finish_bytes=max(
            8.0 * (3 * sources**2 + 2 * CHUNKS * sources * PLACES) + 32.0 * ROWS * sources if full else 0.0,
            EXPECTED * stations * sources,
        ),
        result_bytes=slots * 24.0 * stations,
        wrong="each with its own error",
        figures=3,
        remedy="ask for fewer sources (--set sky.brightest=N)",
    )


def cube_products(settings: CubeAnalysis, channels: int, pixels: int) -> StageWork:
    """Faraday depth, spectra, removal and window of a cube of so many channels, images of `pixels` in all."""
    voxels = float(channels) * pixels
    depths = DEFAULT_DEPTHS
    if settings.depths is not None and len(settings.depths) == 3:
        first, last, step = settings.depths
        depths = int((last - first) / step) + 1
    seconds, held, most, figures = 0.0, 0.0, 0.0, 0
    if settings.wants("spectrum-2d"):
        seconds += 3 * 4e-7 * pixels
        most, figures = max(most, 200.0 * pixels), figures + 1
    if settings.wants("cylindrical") or settings.wants("spherical"):
        seconds += 4 * 2e-7 * voxels
        most = max(most, 40 * voxels)
        figures += 3 * settings.wants("cylindrical") + settings.wants("spherical")  # of I, P and V; one of all
    if settings.remove is not None:
        seconds += 1e-6 * voxels
        held += 2 * 8 * 4 * voxels
    if settings.wants("window"):
        seconds += 3 * 2e-7 * voxels
        figures += 1
    peak = held + most + 4 * 8 * voxels  # in kelvin
    if settings.wants("faraday") and channels > 1:  # after them
        seconds += 2.5e-10 * channels * depths * pixels * (40 if settings.clean else 1) + 2e-8 * depths * pixels
        held += 8.0 * depths * pixels * (4 if settings.clean else 1)
        peak = max(peak, held + 2.0 * depths * pixels)
        figures += 3
    text = "all products" if settings.products is None else ", ".join(settings.products) or "nothing"
    return StageWork(f"of the cube: {text}", finish_seconds=seconds, finish_bytes=peak, result_bytes=held,
                     figures=figures, remedy="ask for fewer pixels, channels or depths")  # fmt: skip


def together(works: list[StageWork]) -> StageWork:
    """What several parts of one stage cost."""
    kept = [w.result_bytes for w in works]
    return StageWork(
        "; ".join(w.does for w in works),
        seconds=sum(w.seconds for w in works),
        finish_seconds=sum(w.finish_seconds for w in works),
        held_bytes=sum(w.held_bytes for w in works),
        block_bytes=max((w.block_bytes for w in works), default=0.0),
        # one after the other: what the parts before have left, and what the part at work takes
        finish_bytes=max((sum(kept[:k]) + w.finish_bytes for k, w in enumerate(works)), default=0.0),
        result_bytes=sum(kept),
        wrong="; ".join(w.wrong for w in works if w.wrong),
        figures=sum(w.figures for w in works),
        remedy=next((w.remedy for w in works if w.remedy), ""),
    )
