//! Smallest distance of a tool that touched nothing to the tissue.

use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{LocalSample, ParticipantId};
use palpate_tissue::{Clearance, Topology, Vec3};

use super::ToolAt;
use super::convert::orientation;

/// Distance between two kept poses, m: fine enough for a report in tenths of a millimetre.
const STEP_M: f64 = 5e-4;

/// Maximum number of poses. Beyond it every second one is dropped and the step doubles.
const POSES_MAX: usize = 8192;

/// The path of a tool until its first contact.
#[derive(Debug)]
pub struct Reach {
    tool: ToolDescription,
    step_m: f64,
    path: Vec<LocalSample>,
}

impl Reach {
    /// Starts the path of a tool.
    pub fn new(tool: ToolDescription) -> Self {
        Self {
            tool,
            step_m: STEP_M,
            path: Vec::new(),
        }
    }

    /// Adds a pose of the tool.
    pub fn note(&mut self, sample: &LocalSample) {
        let at = Vec3::from(sample.pose.position_m);
        let is_near = |last: &LocalSample| {
            let moved = (at - Vec3::from(last.pose.position_m)).norm();
            let turned = orientation(&sample.pose).angle_to(&orientation(&last.pose));
            moved + turned * self.tool.length_m < self.step_m
        };
        if self.path.last().is_some_and(is_near) {
            return;
        }
        if self.path.len() == POSES_MAX {
            let mut number = 0;
            self.path.retain(|_| {
                number += 1;
                number % 2 == 1
            });
            self.step_m *= 2.0;
        }
        self.path.push(*sample);
    }

    /// The smallest distance to the surface at rest in mm, negative inside the tissue; `None` without any pose.
    pub fn nearest_mm(&self, topology: &Topology) -> Option<f64> {
        if self.path.is_empty() {
            return None;
        }
        let clearance = Clearance::new(topology);
        let tools = self.path.iter().flat_map(|sample| {
            let at = ToolAt {
                participant: ParticipantId::SERVER,
                description: self.tool,
                position: sample.pose.position_m.into(),
                orientation: orientation(&sample.pose),
                // A cutting blade makes no contact, but its distance counts.
                buttons: 0,
                strength: 1.0,
                returns: false,
                predicted: None,
            };
            at.contacts().collect::<Vec<_>>()
        });
        let distances = tools.filter_map(|tool| clearance.of(&tool));
        let nearest = distances.min_by(|a, b| a.abs().total_cmp(&b.abs()))?;
        Some(nearest * 1e3)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use palpate_protocol::{ClientTime, Pose};
    use palpate_tissue::{Material, block};

    use super::*;

    #[test]
    fn nearest_pose_of_long_path_is_kept() {
        let topology = Topology::new(Arc::new(block([4, 4, 4], 4e-3, &Material::default(), 1)));
        let mut reach = Reach::new(ToolDescription::probe(2e-3));
        assert_eq!(reach.nearest_mm(&topology), None);
        for i in 0..40_000 {
            let up = 30e-3 + (f64::from(i) * 2e-5 - 0.4).abs();
            reach.note(&LocalSample {
                time: ClientTime::from_micros(i64::from(i)),
                pose: Pose {
                    position_m: [8e-3, 8e-3, up],
                    ..Pose::IDENTITY
                },
                buttons: 0,
                force_n: None,
            });
        }
        assert!(reach.path.len() <= POSES_MAX);
        let nearest = reach.nearest_mm(&topology).unwrap();
        assert!((nearest - 12.0).abs() < 0.5, "{nearest}");
    }
}
