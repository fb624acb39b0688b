//! Commercial haptic devices: location of vendor services and libraries, detection and opening.

use std::path::PathBuf;

use palpate_device::backend::haply::{self, Service};
use palpate_device::backend::{Found, dhd, openhaptics};
use palpate_device::{HapticDevice, OpenError};

use super::DeviceKind;

/// Kinds of commercial devices, best first: more degrees of freedom and more force.
const KINDS: [DeviceKind; 3] = [DeviceKind::Dhd, DeviceKind::Haply, DeviceKind::OpenHaptics];

/// Vendor services and libraries, if not in their usual places.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Sources {
    /// The Haply service.
    pub haply: Service,
    /// The file of libHD; `None` uses the system's search path.
    pub libhd: Option<PathBuf>,
    /// The file of libdrd.
    pub libdrd: Option<PathBuf>,
}

impl Sources {
    /// Reads `PALPATE_HAPLY` (`ws://host:port`), `PALPATE_LIBHD` and `PALPATE_LIBDRD`.
    pub fn from_environment() -> Self {
        let file = |name| std::env::var_os(name).map(PathBuf::from);
        let mut haply = Service::default();
        if let Ok(url) = std::env::var("PALPATE_HAPLY") {
            // Events come from the same host, on the vendor's fixed port.
            let host = url.rsplit_once(':').map(|(host, _)| host);
            haply.events = host.map(|host| format!("{host}:10020"));
            haply.simulation = url;
        }
        Self {
            haply,
            libhd: file("PALPATE_LIBHD"),
            libdrd: file("PALPATE_LIBDRD"),
        }
    }
}

/// Connected devices of this kind; none if it is not a commercial kind.
pub(crate) fn find(kind: DeviceKind, sources: &Sources) -> Result<Vec<Found>, OpenError> {
    Ok(match kind {
        DeviceKind::Haply => haply::find(&sources.haply)?,
        DeviceKind::OpenHaptics => vec![openhaptics::find(sources.libhd.as_deref(), None)?],
        DeviceKind::Dhd => dhd::find(sources.libdrd.as_deref())?,
        _ => Vec::new(),
    })
}

/// The best kind with exactly one free device. Without vendor software this returns at once.
pub(super) fn best(sources: &Sources) -> Option<DeviceKind> {
    let is_there = |kind: &DeviceKind| find(*kind, sources).is_ok_and(|found| is_one_free(&found));
    KINDS.into_iter().find(is_there)
}

/// Whether a device can be opened without an id.
fn is_one_free(found: &[Found]) -> bool {
    found.iter().filter(|f| f.is_free).count() == 1
}

/// Opens the device of this kind with this id, or the only one; `None` if it is not a commercial kind.
pub(super) fn open(
    kind: DeviceKind,
    which: Option<&str>,
    sources: &Sources,
) -> Result<Option<Box<dyn HapticDevice>>, OpenError> {
    Ok(Some(match kind {
        DeviceKind::Haply => Box::new(haply::open(&sources.haply, which)?),
        DeviceKind::OpenHaptics => Box::new(openhaptics::open(sources.libhd.as_deref(), which)?),
        DeviceKind::Dhd => Box::new(dhd::open(sources.libdrd.as_deref(), which)?),
        _ => return Ok(None),
    }))
}

#[cfg(test)]
mod tests {
    use palpate_device::backend::Found;
    use palpate_device::backend::haply::Service;

    use super::{KINDS, Sources, best, find, is_one_free, open};

    /// Sources without any vendor software.
    fn nowhere() -> Sources {
        Sources {
            haply: Service {
                // The discard port, where no service listens.
                simulation: "ws://127.0.0.1:9".to_owned(),
                events: None,
            },
            libhd: Some("nowhere/libHD.so".into()),
            libdrd: Some("nowhere/libdrd.so".into()),
        }
    }

    #[test]
    fn kind_without_id_requires_exactly_one_free_device() {
        let of = |free: &[bool]| {
            let found = |is_free: &bool| Found {
                id: String::new(),
                name: String::new(),
                is_free: *is_free,
            };
            is_one_free(&free.iter().map(found).collect::<Vec<Found>>())
        };
        assert!(of(&[true]) && of(&[false, true]));
        assert!(!of(&[]) && !of(&[false]) && !of(&[true, true]));
    }

    #[test]
    fn each_kind_reports_missing_vendor_software() {
        assert_eq!(best(&nowhere()), None);
        for (kind, word) in KINDS.into_iter().zip(["libdrd", "haply.co", "libHD"]) {
            let why = find(kind, &nowhere()).unwrap_err().to_string();
            assert!(why.contains(word), "{why}");
            assert!(open(kind, None, &nowhere()).is_err());
        }
    }
}
