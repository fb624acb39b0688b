//! The rights of the roles, in one table.

use crate::handshake::Role;

/// A right that a role has or lacks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Permission {
    /// Hold a tool, feel with it, and change it.
    HoldTool,
    /// Cut.
    Cut,
    /// Control the session: [`Control`](crate::control::Control).
    Control,
    /// Subscribe to the surface alone: [`Subscription::Thin`](crate::handshake::Subscription). Others need the tissue.
    WatchThin,
    /// Record the session to a file of the own machine.
    Record,
}

impl Permission {
    /// All permissions, in display order.
    pub const ALL: [Self; 5] = [
        Self::HoldTool,
        Self::Cut,
        Self::Control,
        Self::WatchThin,
        Self::Record,
    ];

    /// The name of this permission in tables.
    pub const fn words(self) -> &'static str {
        match self {
            Self::HoldTool => "hold a tool and feel",
            Self::Cut => "cut",
            Self::Control => "control the session",
            Self::WatchThin => "watch with `--subscription thin`",
            Self::Record => "record with `--record FILE`",
        }
    }
}

impl Role {
    /// Whether this role has a permission. Every check of a right asks this table.
    pub const fn may(self, permission: Permission) -> bool {
        match permission {
            Permission::HoldTool | Permission::Cut => {
                matches!(self, Self::Instructor | Self::Trainee)
            }
            Permission::Control => matches!(self, Self::Instructor),
            // A recording has the whole tissue.
            Permission::WatchThin => matches!(self, Self::Spectator),
            Permission::Record => true,
        }
    }

    /// Whether a participant of this role has a tool.
    pub const fn has_tool(self) -> bool {
        self.may(Permission::HoldTool)
    }
}
