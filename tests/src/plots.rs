//! Plots of a report.

use crate::chart::{BLUE, Chart, GREEN, GREY, Line, Mark, ORANGE, PURPLE, Panel};
use crate::disagreement::DisagreementPoint;
use crate::force_error::{ForcePoint, norm};

#[derive(Debug, Clone)]
pub struct TraineeForces<'a> {
    pub name: &'a str,
    /// In the session, over the time of the script.
    pub session: &'a [ForcePoint],
    /// Without a network; empty without a reference.
    pub reference: &'a [ForcePoint],
    /// Begins and ends of dropouts, seconds of script.
    pub dropouts: &'a [(f64, f64)],
}

/// Force over time of every trainee, with the reference. `marks` are in seconds of script.
pub fn forces(trainees: &[TraineeForces<'_>], marks: Vec<Mark>) -> Chart {
    let colours = [BLUE, ORANGE, GREEN].into_iter().cycle();
    let panel = |(trainee, colour): (&TraineeForces<'_>, _)| {
        let force = |p: &ForcePoint| (p.t_s, norm(p.force_n));
        let session = trainee.session.iter().map(force);
        let reference = trainee.reference.iter().map(force);
        let lines = [
            Line::new("in the session", colour, session),
            // Dashed and on top, so that both curves stay visible where they coincide.
            Line::new("without a network", GREY, reference).dashed(true),
            dropouts(trainee),
        ];
        let title = format!("Force on the tool of the {}", trainee.name);
        Panel::new(title, "force (N)", lines)
    };
    let panels = trainees.iter().zip(colours).map(panel).collect();
    Chart::new("Contact force", "time of the script (s)", panels).with_marks(marks)
}

fn dropouts(trainee: &TraineeForces<'_>) -> Line {
    let force = trainee.reference.iter().map(|p| norm(p.force_n));
    let top = force.fold(0.0, f64::max);
    let pulse = |&(from, to): &(f64, f64)| [(from, 0.0), (from, top), (to, top), (to, 0.0)];
    let name = format!("dropouts: {}", trainee.dropouts.len());
    Line::new(name, PURPLE, trainee.dropouts.iter().flat_map(pulse))
}

/// View disagreement over time. `zero_us` is the start of the script on the monotonic clock.
pub fn views(over_time: &[DisagreementPoint], zero_us: i64, marks: Vec<Mark>) -> Chart {
    let line = |name: &str, colour, value: fn(&DisagreementPoint) -> f64| {
        let points = over_time.iter();
        let points = points.map(|p| ((p.t_us - zero_us) as f64 * 1e-6, value(p)));
        Line::new(name, colour, points)
    };
    let lines = [
        line("largest", GREY, |p| p.max_mm),
        line("95th percentile", BLUE, |p| p.p95_mm),
    ];
    let title = "All pairs of participants, in pieces of 0.1 s";
    let panels = vec![Panel::new(title, "distance (mm)", lines)];
    Chart::new("Disagreement of views", "time of the script (s)", panels).with_marks(marks)
}

#[cfg(test)]
mod tests {
    use super::{TraineeForces, forces};
    use crate::force_error::ForcePoint;

    #[test]
    fn dropouts_are_drawn_and_named_where_there_are_any() {
        let points: Vec<ForcePoint> = (0..100)
            .map(|i| ForcePoint {
                t_s: f64::from(i) * 0.01,
                force_n: [0.0, 0.0, 1.0],
                ..ForcePoint::default()
            })
            .collect();
        let svg = |dropouts: &[(f64, f64)]| {
            let trainee = TraineeForces {
                name: "holder",
                session: &points,
                reference: &points,
                dropouts,
            };
            forces(&[trainee], Vec::new()).to_svg()
        };
        assert!(svg(&[(0.2, 0.3), (0.5, 0.6)]).contains("dropouts: 2"));
        assert!(!svg(&[]).contains("dropouts"));
    }
}
