//! Devices that people own: where their maker's services and libraries are, which are plugged in, and opening one.

use std::path::PathBuf;

use nalgebra::Vector3;
use palpate_device::backend::haply::{self, HaplyError, Service};
use palpate_device::backend::{Found, dhd, openhaptics};
use palpate_device::{HapticDevice, Placed, Placement};
use palpate_tissue::Model;

use super::DeviceKind;

/// How far above the tissue the middle of a device's workspace is put, m. The smallest reaches 40 mm down from there.
const ABOVE_M: f64 = 0.02;

/// The kinds of devices that people own, the best first: more degrees of freedom and more force.
const KINDS: [DeviceKind; 3] = [DeviceKind::Dhd, DeviceKind::Haply, DeviceKind::OpenHaptics];

/// Where makers' services and libraries are, when not where they usually are.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Sources {
    /// The Haply service.
    pub haply: Service,
    /// The file of libHD; `None` lets the system look for it.
    pub libhd: Option<PathBuf>,
    /// The file of libdrd.
    pub libdrd: Option<PathBuf>,
}

impl Sources {
    /// As `PALPATE_HAPLY` (`ws://host:port`), `PALPATE_LIBHD` and `PALPATE_LIBDRD` say.
    pub fn from_environment() -> Self {
        let file = |name| std::env::var_os(name).map(PathBuf::from);
        let mut haply = Service::default();
        if let Ok(url) = std::env::var("PALPATE_HAPLY") {
            // Events come from the same host, on the port that the maker gave them.
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

/// Why such a device can not be opened.
#[derive(Debug, thiserror::Error)]
pub enum OwnedError {
    /// An Inverse3.
    #[error(transparent)]
    Haply(#[from] HaplyError),
    /// A Touch or Phantom.
    #[error(transparent)]
    OpenHaptics(#[from] openhaptics::OpenHapticsError),
    /// A device of Force Dimension or a Falcon.
    #[error(transparent)]
    Dhd(#[from] dhd::DhdError),
}

/// The devices of this kind that are plugged in; none of a kind that nobody owns.
pub(crate) fn find(kind: DeviceKind, sources: &Sources) -> Result<Vec<Found>, OwnedError> {
    Ok(match kind {
        DeviceKind::Haply => haply::find(&sources.haply)?,
        DeviceKind::OpenHaptics => vec![openhaptics::find(sources.libhd.as_deref(), None)?],
        DeviceKind::Dhd => dhd::find(sources.libdrd.as_deref())?,
        _ => Vec::new(),
    })
}

/// The best kind of which one is plugged in. Where nothing is installed that is known in a moment.
pub(crate) fn best(sources: &Sources) -> Option<DeviceKind> {
    let is_there = |kind: &DeviceKind| find(*kind, sources).is_ok_and(|found| !found.is_empty());
    KINDS.into_iter().find(is_there)
}

/// Opens the device of this kind with this id, or the only one; `None` for a kind that nobody owns.
pub(crate) fn open(
    kind: DeviceKind,
    which: Option<&str>,
    sources: &Sources,
) -> Result<Option<Box<dyn HapticDevice>>, OwnedError> {
    Ok(Some(match kind {
        DeviceKind::Haply => Box::new(haply::open(&sources.haply, which)?),
        DeviceKind::OpenHaptics => Box::new(openhaptics::open(sources.libhd.as_deref(), which)?),
        DeviceKind::Dhd => Box::new(dhd::open(sources.libdrd.as_deref(), which)?),
        _ => return Ok(None),
    }))
}

/// Puts a device's workspace with its middle `at` a place of the scene, or a little above the middle of the tissue.
pub(crate) fn placed(
    device: Box<dyn HapticDevice>,
    at: Option<Vector3<f64>>,
    model: &Model,
) -> Box<dyn HapticDevice> {
    let at = at.unwrap_or_else(|| above(model));
    let workspace = device.caps().workspace;
    let middle = (workspace.min + workspace.max) / 2.0;
    let placement = Placement::with(Placement::default().turn, middle, at);
    Box::new(Placed::new(device, placement))
}

fn above(model: &Model) -> Vector3<f64> {
    let Some(first) = model.nodes.first() else {
        return Vector3::zeros();
    };
    let (mut min, mut max) = (*first, *first);
    for node in &model.nodes {
        (min, max) = (min.inf(node), max.sup(node));
    }
    let middle = (min + max) / 2.0;
    Vector3::new(middle.x, middle.y, max.z + ABOVE_M)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use palpate_device::backend::haply::Service;
    use palpate_device::backend::sim::{ScriptStart, SimHand};
    use palpate_device::{HapticDevice, Script};
    use palpate_tissue::{Material, block};

    use super::{KINDS, Sources, best, find, open, placed};

    /// A place where nothing is installed.
    fn nowhere() -> Sources {
        Sources {
            haply: Service {
                // The port of nothing: discarded since 1983.
                simulation: "ws://127.0.0.1:9".to_owned(),
                events: None,
            },
            libhd: Some("nowhere/libHD.so".into()),
            libdrd: Some("nowhere/libdrd.so".into()),
        }
    }

    #[test]
    fn where_nothing_is_installed_each_kind_says_what_is_missing() {
        assert_eq!(best(&nowhere()), None);
        for (kind, word) in KINDS.into_iter().zip(["libdrd", "haply.co", "libHD"]) {
            let why = find(kind, &nowhere()).unwrap_err().to_string();
            assert!(why.contains(word), "{why}");
            assert!(open(kind, None, &nowhere()).is_err());
        }
    }

    #[test]
    fn a_device_reaches_the_tissue_wherever_its_own_origin_is() {
        let model = block([10, 10, 6], 4e-3, &Material::default(), 1);
        let script = Script::resting_probe(Vector3::zeros(), 4e-3).unwrap();
        let mut caps = SimHand::new(script.clone(), ScriptStart::not_yet())
            .caps()
            .clone();
        caps.workspace.min = Vector3::new(-0.2, 0.7, 0.1);
        caps.workspace.max = Vector3::new(0.2, 0.9, 0.2);
        let hand = || -> Box<dyn HapticDevice> {
            let start = ScriptStart::not_yet();
            Box::new(SimHand::with_caps(script.clone(), start, caps.clone()))
        };
        let middle_of = |device: Box<dyn HapticDevice>| {
            let workspace = device.caps().workspace;
            (workspace.min + workspace.max) / 2.0
        };
        let (mut min, mut max) = (model.nodes[0], model.nodes[0]);
        for node in &model.nodes {
            (min, max) = (min.inf(node), max.sup(node));
        }
        let middle = middle_of(placed(hand(), None, &model));
        assert!((middle.xy() - (min + max).xy() / 2.0).norm() < 1e-12);
        assert!((middle.z - max.z - super::ABOVE_M).abs() < 1e-12);
        let there = Vector3::new(1.0, 2.0, 3.0);
        assert!((middle_of(placed(hand(), Some(there), &model)) - there).norm() < 1e-12);
    }
}
