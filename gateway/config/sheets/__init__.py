"""Sheets of tags: rows of a spreadsheet as settings of tags, and tags as rows.

A sheet is a CSV or text file of any spreadsheet or PLC program, a workbook, or a project of another
program. Columns are found by their titles. Nothing here knows addresses or limits: the
configuration checks those.
"""

from gateway.config.sheets import link_table
from gateway.config.sheets.grid import Grid, neutral, read_grid
from gateway.config.sheets.layout import adapted, devices_in
from gateway.config.sheets.sheet import Sheet, SheetMistake, read_sheet
