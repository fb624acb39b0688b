//! The tool of a page: it follows the pointer of the page smoothly, on the server's clock.
//!
//! A browser sends poses unevenly: it draws in the same thread, and its samples wait behind pictures. Samples of the page
//! would therefore raise the playout delay of all participants, and a gap of 50 ms would make the tool let go. The
//! server instead moves the tool itself, to the newest pose that the page sent.

use nalgebra::{Quaternion, UnitQuaternion};
use palpate_device::Pose as DevicePose;
use palpate_device::backend::pointer::Follower;
use palpate_protocol::tool::INSERTED_BUTTON;
use palpate_protocol::{Pose, ServerTime, Span, ToolSample};

/// Time between two samples of a tool.
pub(super) const SAMPLE_PERIOD: Span = Span::from_millis(8);

/// A page that sends no pose for this long has let go of its tool. Pages send 30 per second at rest.
const SILENCE_MAX: Span = Span::from_millis(1500);

/// A page that comes back within this distance and angle keeps its tool: its pointer left the view for a moment.
const NEAR_M: f64 = 5e-3;
const NEAR_RAD: f64 = 0.1;

/// Limits of the tool, as of the device `pointer`.
const SPEED_M_PER_S: f64 = 0.4;
const TURN_RAD_PER_S: f64 = 4.0;

/// See the module.
#[derive(Debug)]
pub(super) struct SteeredTool {
    follower: Follower,
    goal: DevicePose,
    buttons: u8,
    /// Whether it is a needle in the tissue.
    is_inserted: bool,
    /// The newest pose of the page.
    heard: ServerTime,
    /// Time of the first sample since the latest silence.
    first: Option<ServerTime>,
    sampled: ServerTime,
}

impl SteeredTool {
    /// A tool at the first pose that the page sent.
    pub(super) fn new(pose: &Pose, now: ServerTime) -> Self {
        let start = device_pose(pose);
        Self {
            follower: Follower::new(start, SPEED_M_PER_S, TURN_RAD_PER_S),
            goal: start,
            buttons: 0,
            is_inserted: false,
            heard: now,
            first: None,
            sampled: now,
        }
    }

    /// Moves the tool to a pose.
    pub(super) fn steer(&mut self, pose: &Pose, buttons: u8, now: ServerTime) {
        if !self.is_held(now) {
            self.first = None;
        }
        (self.goal, self.buttons, self.heard) = (device_pose(pose), buttons, now);
    }

    /// Sets whether the tissue at `view_time` holds it, as a needle. A page has no tissue of its own, so the authoritative shape
    /// decides. A view without samples of the tool decides nothing: after a silence the needle is where it was.
    pub(super) fn hold(&mut self, is_inserted: bool, view_time: ServerTime) {
        let is_sampled = |first| (first..=self.sampled).contains(&view_time);
        if self.first.is_some_and(is_sampled) {
            self.is_inserted = is_inserted;
        }
    }

    /// Whether the page still sends poses.
    pub(super) fn is_held(&self, now: ServerTime) -> bool {
        now - self.heard <= SILENCE_MAX
    }

    /// Whether a page that sends this pose now still has the tool: without a silence, or back at the place.
    pub(super) fn continues(&self, pose: &Pose, now: ServerTime) -> bool {
        let (at, pose) = (self.follower.pose(), device_pose(pose));
        let is_near = (at.position - pose.position).norm() <= NEAR_M
            && at.orientation.angle_to(&pose.orientation) <= NEAR_RAD;
        self.is_held(now) || is_near
    }

    /// The sample of now, if it is due and the page sends poses.
    pub(super) fn poll(&mut self, now: ServerTime) -> Option<ToolSample> {
        let passed = now - self.sampled;
        if passed < SAMPLE_PERIOD || !self.is_held(now) {
            return None;
        }
        self.sampled = now;
        self.first.get_or_insert(now);
        // A server that was held up continues from there.
        let step_s = passed.min(SAMPLE_PERIOD + SAMPLE_PERIOD).as_secs_f64();
        self.follower.step(&self.goal, step_s);
        let DevicePose {
            position,
            orientation,
        } = *self.follower.pose();
        Some(ToolSample {
            time: now,
            pose: Pose {
                position_m: position.into(),
                orientation: orientation.coords.into(),
            },
            buttons: tool_buttons(self.buttons, self.is_inserted),
            force_n: None,
        })
    }
}

/// Buttons of a page and the state of its tool as in a sample.
fn tool_buttons(held: u8, is_inserted: bool) -> u8 {
    let held = held & !INSERTED_BUTTON;
    held | if is_inserted { INSERTED_BUTTON } else { 0 }
}

fn device_pose(pose: &Pose) -> DevicePose {
    let [x, y, z, w] = pose.orientation;
    DevicePose {
        position: pose.position_m.into(),
        orientation: UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(x: f64) -> Pose {
        Pose {
            position_m: [x, 0.0, 0.0],
            ..Pose::IDENTITY
        }
    }

    #[test]
    fn samples_carry_the_decision_of_the_tissue_and_none_of_the_page() {
        let ms = |ms: i64| ServerTime::from_micros(1000 * ms);
        let mut tool = SteeredTool::new(&at(0.0), ms(0));
        tool.steer(&at(0.0), INSERTED_BUTTON | 2, ms(1));
        assert_eq!(tool.poll(ms(10)).unwrap().buttons, 2);
        tool.hold(true, ms(10));
        assert_eq!(tool.poll(ms(20)).unwrap().buttons, INSERTED_BUTTON | 2);
    }

    #[test]
    fn needle_stays_in_the_tissue_over_a_silence() {
        let ms = |ms: i64| ServerTime::from_micros(1000 * ms);
        let mut tool = SteeredTool::new(&at(0.0), ms(0));
        tool.steer(&at(0.0), 0, ms(1));
        tool.poll(ms(10)).unwrap();
        tool.hold(true, ms(10));
        // The shape lets go of a tool without samples.
        assert_eq!(tool.poll(ms(2000)), None);
        tool.hold(false, ms(2000));
        assert!(tool.continues(&at(0.004), ms(4000)));
        assert!(!tool.continues(&at(0.006), ms(4000)));
        tool.steer(&at(0.004), 0, ms(4000));
        assert_eq!(tool.poll(ms(4010)).unwrap().buttons, INSERTED_BUTTON);
        // A late view of the silence.
        tool.hold(false, ms(4005));
        assert_eq!(tool.poll(ms(4020)).unwrap().buttons, INSERTED_BUTTON);
        tool.hold(false, ms(4010));
        assert_eq!(tool.poll(ms(4030)).unwrap().buttons, 0);
    }

    #[test]
    fn uneven_poses_become_even_samples_within_the_speed_limit() {
        let ms = |ms: i64| ServerTime::from_micros(1000 * ms);
        let mut tool = SteeredTool::new(&at(0.0), ms(0));
        let mut last = 0.0;
        let mut samples = 0;
        for t in 1..=1000 {
            // Poses come in heaps, with gaps of 90 ms.
            if t % 100 < 10 {
                tool.steer(&at(2e-4 * f64::from(t as i32)), 1, ms(t));
            }
            if let Some(sample) = tool.poll(ms(t)) {
                let x = sample.pose.position_m[0];
                assert!(x >= last && x - last <= SPEED_M_PER_S * 0.008 + 1e-9);
                assert_eq!(sample.time, ms(t));
                (last, samples) = (x, samples + 1);
            }
        }
        assert_eq!(samples, 125);
        assert!(last > 0.15, "{last}");
        assert!(tool.is_held(ms(2000)) && !tool.is_held(ms(3000)));
    }
}
