"""The record that comes with the package."""

from importlib import resources

from jaxrock.motions.files.reading import read_record
from jaxrock.motions.record import Record


def example_record() -> Record:
    """The record that comes with the package: a near-fault pulse of the Imperial Valley earthquake.

    **Returns:** a `Record` of 5690 samples, 0.01 s apart, with a peak of 0.311 g (305.02 cm/s^2) at 4.06 s.

    **Source:** Imperial Valley earthquake of 15 October 1979; El Centro - Highway 8/Meloland Overpass,
    free field, 360 degrees; CSMIP station 1336, processed by USGS. Data from the Center for Engineering
    Strong Motion Data (strongmotioncenter.org).
    """
    with resources.as_file(resources.files("jaxrock") / "data" / "meloland_1979_chan15.v2") as path:
        return read_record(path)
