//! A device in the user's hand: initial tool position and reach in the scene.

use nalgebra::Vector3;
use palpate_device::backend::steered::Space;
use palpate_device::{HapticDevice, Placed, Placement, Pose, Script, Workspace};
use palpate_tissue::Model;

use super::DeviceKind;

/// Initial height of a tool above the tissue without a script, m. The smallest workspace reaches 40 mm below its
/// centre.
const ABOVE_M: f64 = 0.02;

/// Distance beyond the tissue that a steered tool may reach, m.
const MARGIN_M: f64 = 0.1;

/// Reach of a steered tool around its initial position before the tissue is known, m.
const AROUND_M: f64 = 0.2;

/// A box: lowest and highest corner, m.
type Extent = (Vector3<f64>, Vector3<f64>);

/// A held device and its placement.
#[derive(Debug, Clone)]
pub(crate) struct HeldDevice {
    /// The requested device, or the best connected one.
    pub(crate) kind: DeviceKind,
    /// Initial pose of the script, and the bounding box of its way points.
    script: Option<(Pose, Extent)>,
    tissue: Option<Extent>,
}

impl HeldDevice {
    /// A script does not move a held device; it only places it.
    pub(crate) fn new(kind: DeviceKind, script: Option<&Script>) -> Self {
        Self {
            kind,
            script: script.map(|script| {
                let first = &script.waypoints()[0];
                let begins = Pose {
                    position: first.position,
                    orientation: first.orientation,
                };
                let waypoints = script.waypoints().iter().map(|way| way.position);
                (begins, extent(first.position, waypoints))
            }),
            tissue: None,
        }
    }

    /// Sets the tissue to reach; known once the session's model has arrived.
    pub(crate) fn place_workspace(&mut self, model: &Model) {
        let nodes = || model.nodes.iter().copied();
        self.tissue = nodes().next().map(|first| extent(first, nodes()));
    }

    /// Centre of the workspace of a device with limited reach, m: the centre of the script's way points, or a little
    /// above the tissue.
    fn middle(&self) -> Vector3<f64> {
        match self.script {
            Some((_, (min, max))) => (min + max) / 2.0,
            None => self.above(),
        }
    }

    fn above(&self) -> Vector3<f64> {
        self.tissue.map_or_else(Vector3::zeros, |(min, max)| {
            let middle = (min + max) / 2.0;
            Vector3::new(middle.x, middle.y, max.z + ABOVE_M)
        })
    }

    /// Places a motorised device, whose workspace is fixed, so that it reaches the tissue.
    pub(crate) fn placed(&self, device: Box<dyn HapticDevice>) -> Box<dyn HapticDevice> {
        let workspace = device.caps().workspace;
        let middle = (workspace.min + workspace.max) / 2.0;
        let placement = Placement::with(Placement::default().turn, middle, self.middle());
        Box::new(Placed::new(device, placement))
    }

    /// Space of a steered tool without limits of its own: all around the tissue, from the script's initial pose or
    /// from a little above.
    pub(super) fn space(&self) -> Space {
        let start = self
            .script
            .map_or_else(|| Pose::at(self.above()), |(begins, _)| begins);
        let at = start.position;
        let (margin, around) = (Vector3::repeat(MARGIN_M), Vector3::repeat(AROUND_M));
        let (min, max) = self
            .tissue
            .map_or((at - around, at + around), |(min, max)| {
                ((min - margin).inf(&at), (max + margin).sup(&at))
            });
        Space {
            workspace: Workspace { min, max },
            start,
        }
    }
}

/// The bounding box of `first` and the rest.
fn extent(first: Vector3<f64>, rest: impl Iterator<Item = Vector3<f64>>) -> Extent {
    rest.fold((first, first), |(min, max), p| (min.inf(&p), max.sup(&p)))
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use palpate_device::backend::sim::{ScriptStart, SimHand};
    use palpate_device::script::{Hand, Tool, Waypoint};
    use palpate_device::{HapticDevice, Script};
    use palpate_tissue::{Material, Model, block};

    use super::{ABOVE_M, DeviceKind, HeldDevice, MARGIN_M};

    fn tissue() -> Model {
        block([10, 10, 6], 4e-3, &Material::default(), 1)
    }

    /// A script that begins far away and moves 20 mm.
    fn script() -> Script {
        let begins = Vector3::new(2.0, 0.0, 0.0);
        let waypoints = vec![
            Waypoint::new(0.0, begins),
            Waypoint::new(1.0, begins + Vector3::new(0.0, 0.02, 0.0)),
        ];
        Script::new(Tool::probe(4e-3), Hand::default(), waypoints, false).unwrap()
    }

    fn found(kind: DeviceKind, script: Option<&Script>) -> HeldDevice {
        let mut hold = HeldDevice::new(kind, script);
        hold.place_workspace(&tissue());
        hold
    }

    /// Above the middle of the tissue, computed independently.
    fn above() -> Vector3<f64> {
        let nodes = tissue().nodes;
        let side = |axis: usize, least: bool| {
            let along = nodes.iter().map(|n| n[axis]);
            if least {
                along.fold(f64::MAX, f64::min)
            } else {
                along.fold(f64::MIN, f64::max)
            }
        };
        let half = |axis| f64::midpoint(side(axis, true), side(axis, false));
        Vector3::new(half(0), half(1), side(2, false) + ABOVE_M)
    }

    #[test]
    fn motorised_device_reaches_tissue_for_any_device_origin() {
        let at_rest = Script::resting_probe(Vector3::zeros(), 4e-3).unwrap();
        let start = ScriptStart::not_yet;
        let mut caps = SimHand::new(at_rest.clone(), start()).caps().clone();
        caps.workspace.min = Vector3::new(-0.2, 0.7, 0.1);
        caps.workspace.max = Vector3::new(0.2, 0.9, 0.2);
        let middle_of = |hold: HeldDevice| {
            let hand = SimHand::with_caps(at_rest.clone(), start(), caps.clone());
            let workspace = hold.placed(Box::new(hand)).caps().workspace;
            (workspace.min + workspace.max) / 2.0
        };
        let middle = middle_of(found(DeviceKind::Dhd, None));
        assert!((middle - above()).norm() < 1e-12, "{middle:?}");
        let middle = middle_of(found(DeviceKind::Dhd, Some(&script())));
        let waypoints = Vector3::new(2.0, 0.01, 0.0);
        assert!((middle - waypoints).norm() < 1e-12, "{middle:?}");
    }

    #[test]
    fn steered_tool_starts_above_tissue_and_reaches_around_it() {
        let space = found(DeviceKind::Gamepad, None).space();
        assert!((space.start.position - above()).norm() < 1e-12);
        let margin = Vector3::repeat(0.99 * MARGIN_M);
        for node in &tissue().nodes {
            assert!(space.workspace.contains(&(node - margin)));
            assert!(space.workspace.contains(&(node + margin)));
        }
    }

    #[test]
    fn script_start_is_within_reach_of_steered_tool() {
        let script = script();
        let space = found(DeviceKind::SpaceMouse, Some(&script)).space();
        let first = &script.waypoints()[0];
        assert_eq!(
            (space.start.position, space.start.orientation),
            (first.position, first.orientation)
        );
        assert!(space.workspace.contains(&first.position));
    }

    #[test]
    fn steered_tool_opens_before_tissue_is_known() {
        let space = HeldDevice::new(DeviceKind::Gamepad, None).space();
        assert!(space.workspace.contains(&space.start.position));
    }
}
