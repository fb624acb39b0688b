//! Alignments over emulated networks.

use rand::RngExt;
use rand_pcg::Pcg64;

use super::Alignment;
use super::way::Way;
use crate::network::{Direction, Path, Profile};

/// Size of a packet of four samples in bytes, for links with limited bandwidth.
const PACKET_BYTES: usize = 120;

/// One direction of a site's path. A checksum rejects damaged packets, so they count as lost.
struct Emulated(Path);

impl Way for Emulated {
    fn delay_us(&mut self, sent_us: i64) -> Option<i64> {
        let sent = u64::try_from(sent_us).ok()?;
        let arrivals = self.0.send(sent, PACKET_BYTES);
        let whole = arrivals.iter().find(|a| a.corrupted.is_none())?;
        i64::try_from(whole.at_us.saturating_sub(sent)).ok()
    }
}

/// An alignment whose sites both reach the server over a network of this profile. Each tool's samples pass
/// an uplink and a downlink.
pub fn emulated(
    profile: &Profile,
    seed: u64,
) -> Alignment<impl Fn(usize, Pcg64, Pcg64) -> Box<dyn Way> + use<>> {
    let profile = profile.clone();
    let ways = move |number: usize, _: Pcg64, mut air: Pcg64| -> Box<dyn Way> {
        let direction = [Direction::Up, Direction::Down][number % 2];
        let path = Path::new(&profile, air.random(), (number / 2) as u64, direction);
        Box::new(Emulated(path))
    };
    Alignment {
        ways,
        seed,
        motion: None,
    }
}
