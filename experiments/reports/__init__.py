"""Reports: screens, figures, HTML reports and exports of finished results."""
