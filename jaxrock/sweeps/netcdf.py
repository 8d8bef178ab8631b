"""NetCDF files that end with a checksum of all preceding bytes; readers of NetCDF ignore it.

The whole file is verified before HDF5 reads it: the C library may abort the process over a damaged file, and over one
that it cannot write.
"""

import hashlib
import threading
from pathlib import Path

from jaxrock._arguments.tables import needed
from jaxrock._core.atomic_files import written_atomically
from jaxrock._core.regular_files import open_regular

_MARK = b"\njaxrock sha256 "
_DIGEST = hashlib.sha256().digest_size


class _Patient:
    """A file that HDF5 can always write and close: the first error is kept, and later calls do nothing.

    HDF5 cannot close a file that it could not write, and Python ends with a segmentation fault when it tries again.
    """

    def __init__(self, file, stopped: threading.Event):
        self._file, self._stopped = file, stopped
        self.error: BaseException | None = None

    def _try(self, does, *given):
        if self._stopped.is_set():
            self.error = self.error or InterruptedError()
        if self.error is None:
            try:
                return does(*given)
            except BaseException as error:
                self.error = error
        return None

    def _write(self, at: int, data) -> None:
        self._file.seek(at)
        view = memoryview(data).cast("B")
        while view:  # a disk that is nearly full accepts only a part
            view = view[self._file.write(view) :]

    def _read(self, at: int, buffer) -> int:
        self._file.seek(at)
        return self._file.readinto(buffer)

    # The methods that h5py calls.

    _at = 0

    def seek(self, offset: int, whence: int = 0) -> int:
        """Move to a place, counted from the beginning, from here or from the end."""
        end = (self._try(self._file.seek, 0, 2) or 0) if whence == 2 else 0
        self._at = offset + (0, self._at, end)[whence]
        return self._at

    def tell(self) -> int:
        """Return the current position."""
        return self._at

    def read(self, size: int = -1) -> bytes:
        """Make h5py recognise this object as a file; h5py itself reads into its own memory."""
        raise NotImplementedError

    def readinto(self, buffer) -> int:
        """Read into a buffer."""
        count = self._try(self._read, self._at, buffer) or 0
        self._at += count
        return count

    def write(self, data) -> int:
        """Write, or keep the error."""
        size = memoryview(data).nbytes
        self._try(self._write, self._at, data)
        self._at += size
        return size

    def truncate(self, size: int) -> int:
        """Cut or lengthen the file."""
        self._try(self._file.truncate, size)
        return size

    def flush(self) -> None:
        """Do nothing: writes are unbuffered."""


def write_dataset(dataset, path: Path, stopped: threading.Event) -> None:
    """Write an `xarray.Dataset` to a new file, completely or not at all; write nothing if `stopped` is set."""
    h5netcdf, backends = needed("h5netcdf"), needed("xarray.backends")
    with written_atomically(path) as aside, aside.open("w+b", buffering=0) as file:
        patient = _Patient(file, stopped)
        try:
            with h5netcdf.File(patient, "w") as opened:
                dataset.dump_to_store(backends.H5NetCDFStore(opened))
        except BaseException as error:
            patient.error = patient.error or error
        if patient.error is not None:
            raise patient.error
        file.seek(0)
        digest = hashlib.file_digest(file, "sha256").digest()
        patient._write(file.seek(0, 2), _MARK + digest)


def opened_dataset(path: Path):
    """Return the `xarray.Dataset` of an undamaged file.

    **Raises:** ValueError for a damaged one.
    """
    xarray = needed("xarray")
    needed("h5netcdf")
    _verify(path)
    return xarray.open_dataset(path, engine="h5netcdf", mask_and_scale=False)


def _verify(path: Path) -> None:
    with open_regular(path) as file:
        size = file.seek(0, 2) - len(_MARK) - _DIGEST
        file.seek(max(size, 0))
        mark, told = file.read(len(_MARK)), file.read()
        file.seek(0)
        found, left = hashlib.sha256(), size
        while left > 0:
            part = file.read(min(left, 2**24))
            if not part:
                break
            found.update(part)
            left -= len(part)
    if mark != _MARK:
        raise ValueError(
            f"The file {path} is damaged, or was not saved by a `Grid`: the checksum at its end is missing."
        )
    if told != found.digest():
        raise ValueError(f"The file {path} is damaged: it does not agree with its checksum.")
