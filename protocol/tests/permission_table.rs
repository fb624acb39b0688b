//! Compares the table of permissions in the README with the code.

use palpate_protocol::Role;
use palpate_protocol::permission::Permission;

const README: &str = include_str!("../../README.md");

fn table() -> String {
    let row = |head: &str, cells: Vec<&str>| format!("| {head} | {} |\n", cells.join(" | "));
    let mut table = row("may", Role::ALL.iter().map(|r| r.word()).collect());
    table += &row("---", vec!["---"; Role::ALL.len()]);
    for permission in Permission::ALL {
        let cell = |role: &Role| {
            if role.may(permission) { "yes" } else { "no" }
        };
        table += &row(permission.words(), Role::ALL.iter().map(cell).collect());
    }
    table
}

#[test]
fn readme_has_the_table_of_permissions() {
    let table = table();
    assert!(
        README.contains(&table),
        "README.md should contain this table:\n{table}"
    );
}

#[test]
fn no_two_roles_have_equal_rights() {
    let rights = |role: Role| Permission::ALL.map(|p| role.may(p));
    for (i, one) in Role::ALL.into_iter().enumerate() {
        for other in &Role::ALL[i + 1..] {
            assert_ne!(rights(one), rights(*other), "{one} and {other}");
        }
    }
}
