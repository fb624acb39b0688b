//! A device in somebody's own hand: where its tool begins, and what it can reach of the scene.

use nalgebra::Vector3;
use palpate_device::backend::steered::Space;
use palpate_device::{HapticDevice, Placed, Placement, Pose, Script, Workspace};
use palpate_tissue::Model;

use super::DeviceKind;

/// How far above the tissue a tool begins that no script places, m. The smallest workspace reaches 40 mm down from its
/// middle.
const ABOVE_M: f64 = 0.02;

/// How far beyond the tissue a steered tool may go, m.
const MARGIN_M: f64 = 0.1;

/// How far a steered tool may go from where it begins, m, while nobody knows of any tissue.
const AROUND_M: f64 = 0.2;

/// A box, as its lowest and its highest corner, m.
type Extent = (Vector3<f64>, Vector3<f64>);

/// Which device somebody holds, and where it is put.
#[derive(Debug, Clone)]
pub(crate) struct Hold {
    /// The device: the one that was asked for, or the best that is here.
    pub(crate) kind: DeviceKind,
    /// Where the script begins, and the box around its way points.
    script: Option<(Pose, Extent)>,
    tissue: Option<Extent>,
}

impl Hold {
    /// A script does not move it: it only says where it is.
    pub(crate) fn new(kind: DeviceKind, script: Option<&Script>) -> Self {
        Self {
            kind,
            script: script.map(|script| {
                let first = &script.ways()[0];
                let begins = Pose {
                    position: first.position,
                    orientation: first.orientation,
                };
                let ways = script.ways().iter().map(|way| way.position);
                (begins, extent(first.position, ways))
            }),
            tissue: None,
        }
    }

    /// The tissue that it is to reach, which is not known before the session's model is here.
    pub(crate) fn find_place(&mut self, model: &Model) {
        let nodes = || model.nodes.iter().copied();
        self.tissue = nodes().next().map(|first| extent(first, nodes()));
    }

    /// Where a device that can not go everywhere has the middle of its workspace, m: in the middle of the script's way
    /// points, or a little above the tissue.
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

    /// Puts a device with motors, whose workspace is as large as it is, where it reaches the tissue.
    pub(crate) fn placed(&self, device: Box<dyn HapticDevice>) -> Box<dyn HapticDevice> {
        let workspace = device.caps().workspace;
        let middle = (workspace.min + workspace.max) / 2.0;
        let placement = Placement::with(Placement::default().turn, middle, self.middle());
        Box::new(Placed::new(device, placement))
    }

    /// Where a tool may go that is steered and has no end of its own: all around the tissue, from where the script
    /// begins or from a little above.
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

/// The box around `first` and the rest.
fn extent(first: Vector3<f64>, rest: impl Iterator<Item = Vector3<f64>>) -> Extent {
    rest.fold((first, first), |(min, max), p| (min.inf(&p), max.sup(&p)))
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use palpate_device::backend::sim::{ScriptStart, SimHand};
    use palpate_device::script::{Hand, Tool, WayPoint};
    use palpate_device::{HapticDevice, Script};
    use palpate_tissue::{Material, Model, block};

    use super::{ABOVE_M, DeviceKind, Hold, MARGIN_M};

    fn tissue() -> Model {
        block([10, 10, 6], 4e-3, &Material::default(), 1)
    }

    /// Begins far away, and goes 20 mm from there.
    fn script() -> Script {
        let begins = Vector3::new(2.0, 0.0, 0.0);
        let ways = vec![
            WayPoint::new(0.0, begins),
            WayPoint::new(1.0, begins + Vector3::new(0.0, 0.02, 0.0)),
        ];
        Script::new(Tool::probe(4e-3), Hand::default(), ways, false).unwrap()
    }

    fn found(kind: DeviceKind, script: Option<&Script>) -> Hold {
        let mut hold = Hold::new(kind, script);
        hold.find_place(&tissue());
        hold
    }

    /// Above the middle of the tissue, worked out once more.
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
    fn a_device_with_motors_reaches_the_tissue_wherever_its_own_origin_is() {
        let at_rest = Script::resting_probe(Vector3::zeros(), 4e-3).unwrap();
        let start = ScriptStart::not_yet;
        let mut caps = SimHand::new(at_rest.clone(), start()).caps().clone();
        caps.workspace.min = Vector3::new(-0.2, 0.7, 0.1);
        caps.workspace.max = Vector3::new(0.2, 0.9, 0.2);
        let middle_of = |hold: Hold| {
            let hand = SimHand::with_caps(at_rest.clone(), start(), caps.clone());
            let workspace = hold.placed(Box::new(hand)).caps().workspace;
            (workspace.min + workspace.max) / 2.0
        };
        let middle = middle_of(found(DeviceKind::Dhd, None));
        assert!((middle - above()).norm() < 1e-12, "{middle:?}");
        let middle = middle_of(found(DeviceKind::Dhd, Some(&script())));
        let ways = Vector3::new(2.0, 0.01, 0.0);
        assert!((middle - ways).norm() < 1e-12, "{middle:?}");
    }

    #[test]
    fn a_steered_tool_begins_above_the_tissue_and_can_go_all_around_it() {
        let space = found(DeviceKind::Gamepad, None).space();
        assert!((space.start.position - above()).norm() < 1e-12);
        let margin = Vector3::repeat(0.99 * MARGIN_M);
        for node in &tissue().nodes {
            assert!(space.workspace.contains(&(node - margin)));
            assert!(space.workspace.contains(&(node + margin)));
        }
    }

    #[test]
    fn a_script_says_where_a_steered_tool_begins_and_that_is_within_its_reach() {
        let script = script();
        let space = found(DeviceKind::SpaceMouse, Some(&script)).space();
        let first = &script.ways()[0];
        assert_eq!(
            (space.start.position, space.start.orientation),
            (first.position, first.orientation)
        );
        assert!(space.workspace.contains(&first.position));
    }

    #[test]
    fn before_any_tissue_is_known_a_steered_tool_has_room_to_be_opened() {
        let space = Hold::new(DeviceKind::Gamepad, None).space();
        assert!(space.workspace.contains(&space.start.position));
    }
}
