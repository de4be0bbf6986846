from swath import aio as aio
from swath import error_model as error_model
from swath.daemon.errors import SwathError as SwathError
from swath.logs import Capture as Capture
from swath.logs import Log as Log
from swath.logs import Source as Source
from swath.logs import gps_ns as gps_ns
from swath.logs import open as open
from swath.logs import read_pcap as read_pcap
from swath.processing import CalibrationResult as CalibrationResult
from swath.processing import PointCloud as PointCloud
from swath.processing import Track as Track
from swath.processing import calibrate as calibrate
from swath.processing import georeference as georeference
from swath.processing import navigate as navigate

__version__: str
__all__: list[str]
