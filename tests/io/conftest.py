"""Files as the instruments write them, small and with known content."""

import numpy as np
import pytest
import tifffile

HPDTA_TEXT = (
    '[Application],Enconding=UTF-8,Date="5/2/2021",Software="HPD-TA",ApplicationTitle="High Performance, Digital"\r\n'
    '[Camera],CameraName="C11440-22C",SerialNumber="S/N: 1",Prop_BitPerChannel={bits},'
    "Prop_ConversionFactorOffset=100\r\n"
    '[Acquisition],NrExposure={exposures},ExposureTime=300 ms,areSource="0,{top},30,20"\r\n'
    "[Grabber],Type=5,SubType=0[DisplayLUT],EntrySize=7\r\n"
    '[Streak camera],Time Range="20 ns",MCP Gain="27",Trig. level="0.3"\r\n'
    '[Scaling],ScalingYType={kind},ScalingYScale={scale},ScalingYUnit="{unit}",'
    'ScalingYScalingFile="{place}"[Comment],UserComment=""'
)


@pytest.fixture
def pixels():
    """Raw counts above the camera's offset of 100."""
    return np.random.default_rng(5).integers(100, 4000, (20, 30)).astype(np.uint16)


@pytest.fixture
def write_hpdta(tmp_path, pixels):
    """Write an HPD-TA TIFF, its table of times (in `unit`) behind everything else."""

    def write(table=None, place="", picture=pixels, **text):
        path = tmp_path / "shot.tif"
        entries = {"bits": 16, "exposures": 1, "top": 0, "kind": 2, "scale": 1, "unit": "ns"} | text

        def save(place):
            description = HPDTA_TEXT.format(place=place, **entries)
            tifffile.imwrite(
                path,
                picture,
                description=description,
                metadata=None,
                datetime="2021:05:02 20:49:12",
            )

        if table is not None and not place:
            # Two texts of the same length make files of the same size, behind which the table will
            # lie.
            save(f"#{0:012d},{table.size:04d}")
            place = f"#{path.stat().st_size:012d},{table.size:04d}"
        save(place)
        if table is not None:
            with path.open("ab") as file:
                file.write(np.asarray(table, dtype="<f4").tobytes())
        return path

    return write


@pytest.fixture
def lift_entries():
    """Entries of a non-line-of-sight archive with three views; the wall is seen by a pinhole of 250
    px.
    """
    columns, rows = np.meshgrid(np.arange(5) - 2.0, np.arange(5) - 2.0)
    sight = np.stack([columns * 10, rows * 10, np.full(columns.shape, 250.0)])
    return {
        "streak_raw": np.random.default_rng(3).integers(0, 50, (12, 60)).astype(np.float64),
        "dt_s": np.array(4.6e-12),
        "n_lens": np.array(3),
        "resample_flag": np.array(1),
        "image_inverted_flag": np.array(0),
        "lens_centre_px": np.array([11.0, 30.5, 50.0]),
        "lens_angle_deg": np.array([45.0, 90.0, 127.0]),
        "region_size_px": np.array(11),
        "rectify_kind": np.array("polynomial2"),
        "rectify_poly_u": np.array([0.003, 1.01, -0.02, 0.005, -0.0016, -0.0015]),
        "rectify_poly_v": np.array([-9e-5, -0.006, 0.97, -0.0065, 1.6e-4, -1.7e-4]),
        "rectify_norm_xy": np.array([[30.0, 0.0, 0.0], [0.0, 28.0, 0.0], [31.5, 6.25, 1.0]]),
        "rectify_norm_uv": np.array([[29.0, 0.0, 0.0], [0.0, 27.0, 0.0], [30.25, 6.5, 1.0]]),
        "camera_pos_m": np.array([1.0, -0.3, -1.4]),
        "laser_pos_m": np.zeros(3),
        "wall_grid_m": np.array([1.0, -0.3, -1.4])[:, None, None] + sight / 150.0,
        "receive_delay_bins": np.array(100),
    }


@pytest.fixture
def write_lift(tmp_path, lift_entries):
    """Write a LIFT archive; keywords replace its entries, None leaves one out."""

    def write(**changes):
        path = tmp_path / "shot.npz"
        np.savez_compressed(
            path, **{k: v for k, v in (lift_entries | changes).items() if v is not None}
        )
        return path

    return write
