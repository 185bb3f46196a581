"""Files of photon-counting electronics, written byte by byte or by the libraries' own writers."""

import struct

import numpy as np

RESOLUTION = 32e-12
PERIOD = 25e-9


def make_decays():
    """Counts of two channels in 200 bins, (channels, bins)."""
    decay = 20 * np.exp(-np.arange(200) / 30)
    return np.random.default_rng(2).poisson([decay, np.roll(decay, 40)]).astype(np.uint16)


def write_ptu(path, decays):
    """One pixel of an image."""
    import ptufile

    image = decays[np.newaxis, np.newaxis, np.newaxis]  # frame, line, pixel, channel, bin
    options = {"global_resolution": PERIOD, "tcspc_resolution": RESOLUTION, "pixel_time": 1e-3}
    ptufile.imwrite(path, image, **options)


def tag(name, number, kind, value):
    return struct.pack("<32siI8s", name.encode(), number, kind, value)


def integer(name, value, number=-1):
    return tag(name, number, 0x10000008, struct.pack("<q", value))


def real(name, value):
    return tag(name, -1, 0x20000008, struct.pack("<d", value))


TAGS_END = tag("Header_End", -1, 0xFFFF0008, bytes(8))


def write_phu(path, decays):
    """Header, tags, histograms of uint32."""
    channels, bins = decays.shape

    def content(offset):
        tags = [
            integer("Measurement_Mode", 0),
            integer("Measurement_SubMode", 1),
            real("MeasDesc_Resolution", RESOLUTION),
            integer("HistoResult_NumberOfCurves", channels),
            integer("HistoResult_BitsPerBin", 32),
        ]
        for number in range(channels):
            tags += [
                integer("HistResDscr_DataOffset", offset + number * bins * 4, number),
                integer("HistResDscr_HistogramBins", bins, number),
            ]
        return b"PQHISTO\0" + b"1.0".ljust(8, b"\0") + b"".join([*tags, TAGS_END])

    path.write_bytes(content(len(content(0))) + decays.astype("<u4").tobytes())


def write_sdt(path, decays):
    """One block for each channel: (channels, bins), or images (channels, rows, columns, bins)."""
    import sdtfile

    bins, shape = decays.shape[-1], decays.shape[1:-1]
    size = int(np.prod(decays.shape[1:])) * 2
    info = b"*IDENTIFICATION\r\n  ID        : SPC Setup & Data File\r\n  Title     : x\r\n*END\r\n"
    header = np.zeros(1, np.dtype(sdtfile.sdtfile.FILE_HEADER).newbyteorder("<"))
    measurement = np.zeros(1, np.dtype(sdtfile.sdtfile.MEASURE_INFO).newbyteorder("<"))
    block = np.dtype(sdtfile.sdtfile.BLOCK_HEADER).newbyteorder("<")
    measurement["adc_re"], measurement["tac_r"], measurement["tac_g"] = bins, RESOLUTION * bins, 1
    if shape:
        measurement["scan_y"], measurement["scan_x"] = shape
    at = header.nbytes + len(info)
    header["revision"], header["chksum"], header["header_valid"] = 0x0F, 0x55AA, 0x5555
    header["info_offs"], header["info_length"] = header.nbytes, len(info)
    header["meas_desc_block_offs"], header["meas_desc_block_length"] = at, measurement.nbytes
    header["no_of_meas_desc_blocks"], header["no_of_data_blocks"] = 1, len(decays)
    at += measurement.nbytes
    header["data_block_offs"], header["data_block_length"] = at, size
    blocks = b""
    for curve in decays:
        one = np.zeros(1, block)
        one["data_offs"] = at + block.itemsize
        one["next_block_offs"] = at + block.itemsize + size
        one["block_length"] = size
        blocks += one.tobytes() + curve.astype("<u2").tobytes()
        at += block.itemsize + size
    path.write_bytes(header.tobytes() + info + measurement.tobytes() + blocks)


T2_TICK = 1e-12
T2_OVERFLOW = 1 << 25


def write_ptu_t2(
    path,
    pulses,
    photons,
    markers=None,
    scan=None,
):
    """Events tagged by absolute times, as HydraHarps do (version 2): ticks of the laser's `pulses`,
    ticks and channels (from 0) of the `photons`, ticks and bits of the `markers` (by default one with
    every tenth pulse); `scan`: tags of a scanner's picture.
    """
    if markers is None:
        markers = np.stack([pulses[::10], np.ones_like(pulses[::10])], axis=1)
    ticks = np.concatenate([pulses, markers[:, 0], photons[:, 0]])
    # special events: the pulses on channel 0, markers on 1 to 15, overflows on 63
    special = 1 << 31
    marks = special | markers[:, 1] << 25
    words = np.concatenate([np.full(len(pulses), special), marks, photons[:, 1] << 25])
    order = np.argsort(ticks, kind="stable")
    found = []
    turns = 0
    for tick, word in zip(ticks[order].tolist(), words[order].tolist(), strict=True):
        if tick // T2_OVERFLOW > turns:
            found.append(special | 63 << 25 | tick // T2_OVERFLOW - turns)
            turns = tick // T2_OVERFLOW
        found.append(word | tick % T2_OVERFLOW)
    tags = [
        integer("Measurement_Mode", 2),
        integer("Measurement_SubMode", 3 if scan else 0),
        *(
            real(name, value) if isinstance(value, float) else integer(name, value)
            for name, value in (scan or {}).items()
        ),
        integer("TTResultFormat_TTTRRecType", 0x01010204),
        integer("TTResultFormat_BitsPerRecord", 32),
        integer("TTResult_NumberOfRecords", len(found)),
        real("MeasDesc_GlobalResolution", T2_TICK),
        real("MeasDesc_Resolution", T2_TICK),
        TAGS_END,
    ]
    head = b"PQTTTR\0\0" + b"1.0.00".ljust(8, b"\0") + b"".join(tags)
    path.write_bytes(head + np.array(found, "<u4").tobytes())
