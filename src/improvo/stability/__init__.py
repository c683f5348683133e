"""The paper's stability rule on tracks (`rule`), and the tables that keep tracks and labels (`tables`)."""
