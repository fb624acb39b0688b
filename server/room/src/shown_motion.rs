//! The motion of a tool that views show: its samples, and the pose that it holds while the session is frozen.

use palpate_protocol::timeline::{RELEASED_FROM, Timeline};
use palpate_protocol::{Pose, ServerTime, ToolSample};

/// Pose, buttons and contact strength of a tool at one time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ShownPose {
    pub(crate) pose: Pose,
    pub(crate) buttons: u8,
    pub(crate) strength: f64,
    /// Whether the tool returns from a hold.
    pub(crate) returns: bool,
}

/// Motion between two changes of a tool's activity.
#[derive(Debug, Default)]
pub(crate) struct ShownMotion {
    timeline: Timeline,
    newest: Option<(ServerTime, ShownPose)>,
    /// Begin of the freeze, and the held pose; `None` for a tool that was inactive or silent then.
    held: Option<(ServerTime, Option<ShownPose>)>,
}

impl ShownMotion {
    /// Motion that begins now, in a session that has been frozen since `frozen_from`.
    pub(crate) fn new(frozen_from: Option<ServerTime>) -> Self {
        Self {
            held: frozen_from.map(|from| (from, None)),
            ..Self::default()
        }
    }

    /// Whether samples of this time are shown: not those after the begin of a freeze.
    pub(crate) fn shows(&self, time: ServerTime) -> bool {
        self.held.is_none_or(|(from, _)| time <= from)
    }

    /// Adds a sample that is shown.
    pub(crate) fn insert(&mut self, sample: ToolSample) {
        let ToolSample {
            time,
            pose,
            buttons,
            ..
        } = sample;
        if self.newest.is_none_or(|(newest, _)| time > newest) {
            let newest = ShownPose {
                pose,
                buttons,
                strength: 1.0,
                returns: false,
            };
            self.newest = Some((time, newest));
        }
        self.timeline.insert(sample);
    }

    /// Time of the newest sample.
    pub(crate) fn newest(&self) -> Option<ServerTime> {
        self.timeline.newest()
    }

    /// Holds the pose of the newest sample from a time on. Returns it, unless the tool is silent.
    pub(crate) fn hold(&mut self, from: ServerTime) -> Option<ShownPose> {
        let newest = self.newest.filter(|(time, _)| from - *time < RELEASED_FROM);
        let pose = newest.map(|(_, pose)| pose);
        self.held = Some((from, pose));
        pose
    }

    /// Begin of the freeze, if the session is frozen.
    pub(crate) fn frozen_from(&self) -> Option<ServerTime> {
        self.held.map(|(from, _)| from)
    }

    /// Pose at a time; `None` without samples, where they are too old to press, and where a freeze holds none.
    pub(crate) fn at(&mut self, t: ServerTime) -> Option<ShownPose> {
        match self.held {
            Some((from, pose)) if t >= from => pose,
            _ => {
                let shown = self.timeline.at(t).filter(|shown| shown.strength > 0.0)?;
                Some(ShownPose {
                    pose: shown.pose,
                    buttons: shown.buttons,
                    strength: shown.strength,
                    returns: shown.returns,
                })
            }
        }
    }
}
