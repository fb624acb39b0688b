//! Lateness of a track in a datagram.

use super::range_coder::{Coder, Number};
use crate::lateness::{LATENESS_MAX, LATENESS_STEP, Lateness};
use crate::{ProtocolError, Span};

/// Codes the lateness that machines caused: of the newest sample, and the additional one of the oldest news.
pub(super) fn code_lateness(
    c: &mut impl Coder,
    number: &mut Number,
    late: Lateness,
) -> Result<Lateness, ProtocolError> {
    let step = LATENESS_STEP.as_micros();
    let steps = |s: Span| (s.as_micros() / step) as i32;
    let late = late.limited();
    let newest = number.code(c, steps(late.newest))?;
    let more = number.code(c, steps(late.oldest - late.newest))?;
    let most = steps(LATENESS_MAX);
    if newest < 0 || more < 0 || newest > most || more > most - newest {
        return Err(ProtocolError::OutOfRange {
            what: "the lateness of a track",
            detail: format!("{newest} ms and {more} ms more, at most {most} ms together"),
        });
    }
    let span = |steps: i32| Span::from_micros(i64::from(steps) * step);
    Ok(Lateness {
        newest: span(newest),
        oldest: span(newest + more),
    })
}
