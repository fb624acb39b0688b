//! Identifiers on the wire: one type per kind, so that the compiler keeps them apart.

use std::fmt;

use serde::{Deserialize, Serialize};

macro_rules! id {
    ($(#[$doc:meta])* $name:ident($inner:ty), $format:literal) => {
        $(#[$doc])*
        #[derive(
            Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize, Deserialize,
        )]
        #[serde(transparent)]
        pub struct $name(pub $inner);

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, $format, self.0)
            }
        }
    };
}

id! {
    /// One participant of one session. Numbers are not reused within a session, so that an
    /// operation's author stays known after leaving.
    ParticipantId(u16), "#{}"
}

impl ParticipantId {
    /// The server itself: the author of operations without a requester. Participants count from 1.
    pub const SERVER: Self = Self(0);
}

id! {
    /// The incarnation of a session: it grows whenever a server takes the session over. Messages with an
    /// earlier epoch are rejected.
    Epoch(u32), "epoch {}"
}

id! {
    /// The position of an operation in the session's log: consecutive, from 0.
    OperationId(u64), "operation {}"
}

impl OperationId {
    /// The operation after this one.
    #[must_use]
    pub const fn next(self) -> Self {
        Self(self.0.saturating_add(1))
    }
}

id! {
    /// The number a client gives to a request, so that it recognises the answer.
    RequestId(u32), "request {}"
}

id! {
    /// A hash of a model's connectivity. Two sites that applied the same operations have the
    /// same one.
    TopologyHash(u64), "{:016x}"
}

id! {
    /// XXH3 of the bytes of a model file, computed by the caller: it names the model that a
    /// client has to hold before it can join.
    ModelHash(u64), "{:016x}"
}
