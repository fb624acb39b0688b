//! What moves a device that no hand holds, and the tool that it carries.

use nalgebra::Vector3;
use palpate_device::backend::replay::{Moment, Motion, MotionError};
use palpate_device::backend::steered::Space;
use palpate_device::script::{Tool, ToolKind};
use palpate_device::{Buttons, Pose, Script, ScriptError, Workspace};
use palpate_protocol::Role;
use palpate_tissue::Model;

use crate::{ClientError, JoinOptions};

/// The tool of a motion without a script: a ball of 8 mm radius.
const BALL: Tool = Tool {
    kind: ToolKind::Probe,
    radius_m: 8e-3,
    length_m: 0.0,
};

/// How far beyond the tissue a steered tool may go, m.
const MARGIN_M: f64 = 0.1;

/// How far above the tissue a steered tool begins, m.
const ABOVE_M: f64 = 0.03;

/// What moves a device, and what it carries.
#[derive(Debug, Clone)]
pub(crate) struct Guide {
    pub(crate) tool: Tool,
    pub(crate) moves: Moves,
}

/// What moves a device.
#[derive(Debug, Clone)]
pub(crate) enum Moves {
    /// A hand that follows it.
    Script(Script),
    /// The device itself was there.
    Motion(Motion),
    /// Whoever holds it, through this space.
    Hand(Space),
}

impl Guide {
    /// What was asked for; `None` for a role that only looks.
    pub(crate) fn load(options: &JoinOptions, role: Role) -> Result<Option<Self>, ClientError> {
        if !role.has_tool() {
            return Ok(None);
        }
        let script = match &options.script {
            Some(path) => {
                let wrong = |source| ClientError::Script {
                    path: path.clone(),
                    source,
                };
                Some(Script::load(path).map_err(wrong)?)
            }
            None => None,
        };
        if options.device.is_steered() && options.motion.is_none() {
            let begins = script.as_ref().map(|s| {
                let first = &s.ways()[0];
                Pose {
                    position: first.position,
                    orientation: first.orientation,
                }
            });
            return Ok(Some(Self {
                tool: script.map_or(BALL, |s| s.tool()),
                moves: Moves::Hand(space(begins)),
            }));
        }
        let guide = match (&options.motion, script) {
            (Some(path), script) => {
                let wrong = |source| ClientError::Motion {
                    path: path.clone(),
                    source,
                };
                Self {
                    tool: script.map_or(BALL, |s| s.tool()),
                    moves: Moves::Motion(Motion::load(path).map_err(wrong)?),
                }
            }
            (None, Some(script)) => Self {
                tool: script.tool(),
                moves: Moves::Script(script),
            },
            (None, None) => return Err(ClientError::NoScript(role)),
        };
        Ok(Some(guide))
    }

    /// Gives a hand the room that it needs around the model. Without a script it begins above the middle.
    pub(crate) fn find_place(&mut self, model: &Model, has_script: bool) {
        let Moves::Hand(space) = &mut self.moves else {
            return;
        };
        let Some(first) = model.nodes.first() else {
            return;
        };
        let (mut min, mut max) = (*first, *first);
        for node in &model.nodes {
            (min, max) = (min.inf(node), max.sup(node));
        }
        if !has_script {
            let middle = (min + max) / 2.0;
            space.start = Pose::at(Vector3::new(middle.x, middle.y, max.z + ABOVE_M));
        }
        let margin = Vector3::repeat(MARGIN_M);
        let start = space.start.position;
        space.workspace = Workspace {
            min: (min - margin).inf(&start),
            max: (max + margin).sup(&start),
        };
    }

    /// A hand at rest in the origin.
    pub(crate) fn held() -> Self {
        Self {
            tool: BALL,
            moves: Moves::Hand(space(None)),
        }
    }

    /// One at rest in the origin, by a script or a motion.
    pub(crate) fn at_rest(recorded: bool) -> Result<Self, String> {
        let script = || -> Result<Script, ScriptError> {
            Script::resting_probe(Vector3::zeros(), BALL.radius_m)
        };
        let motion = || -> Result<Motion, MotionError> {
            let moment = |t_s| Moment {
                t_s,
                pose: Pose::default(),
                buttons: Buttons::NONE,
            };
            Motion::new(vec![moment(0.0), moment(1.0)])
        };
        let moves = if recorded {
            Moves::Motion(motion().map_err(|e| e.to_string())?)
        } else {
            Moves::Script(script().map_err(|e| e.to_string())?)
        };
        Ok(Self { tool: BALL, moves })
    }
}

/// A cube of 0.4 m around where a hand begins.
fn space(begins: Option<Pose>) -> Space {
    let start = begins.unwrap_or_default();
    let half = Vector3::repeat(0.2);
    Space {
        workspace: Workspace {
            min: start.position - half,
            max: start.position + half,
        },
        start,
    }
}

#[cfg(test)]
mod tests {
    use palpate_device::backend::steered::Space;
    use palpate_tissue::{Material, block};

    use super::{ABOVE_M, Guide, MARGIN_M, Moves};

    fn space(guide: &Guide) -> Space {
        match guide.moves {
            Moves::Hand(space) => space,
            _ => panic!("a hand moves it"),
        }
    }

    #[test]
    fn a_hand_begins_above_the_tissue_and_can_go_all_around_it() {
        let model = block([10, 10, 6], 4e-3, &Material::default(), 1);
        let mut guide = Guide::held();
        guide.find_place(&model, false);
        let found = space(&guide);
        let top = model.nodes.iter().map(|n| n.z).fold(f64::MIN, f64::max);
        assert!((found.start.position.z - top - ABOVE_M).abs() < 1e-12);
        let margin = nalgebra::Vector3::repeat(0.99 * MARGIN_M);
        for node in &model.nodes {
            assert!(found.workspace.contains(&(node - margin)));
            assert!(found.workspace.contains(&(node + margin)));
        }
    }

    #[test]
    fn a_script_says_where_a_hand_begins_and_that_is_within_its_reach() {
        let model = block([10, 10, 6], 4e-3, &Material::default(), 1);
        let mut guide = Guide::held();
        let mut begins = space(&guide);
        begins.start.position.x = 2.0;
        guide.moves = Moves::Hand(begins);
        guide.find_place(&model, true);
        assert_eq!(space(&guide).start, begins.start);
        assert!(space(&guide).workspace.contains(&begins.start.position));
    }
}
